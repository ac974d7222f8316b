"""`python -m preprocess check DIR`: measure a built character again, and say whether it is sound.

From its files alone (preprocess/verify/claims.py), or beside the file that it was built from, too, with `--source`
(preprocess/verify/measure.py): what a build measures of itself before it writes.
"""

from __future__ import annotations

import argparse
import dataclasses
import json
from pathlib import Path

from preprocess.errors import InputError
from preprocess.files.output_folder import hash_file
from preprocess.load import load_character
from preprocess.verify.claims import check_claims
from preprocess.verify.goals import Finding, is_as_built, judge
from preprocess.verify.measure import measure
from runtime.asset.asset import Asset, load
from runtime.errors import AssetError

LONGEST = 160  # characters of a fault in the verdict


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """The folder, and what else to hold it to."""
    parser.add_argument("folder", type=Path, metavar="DIR")
    parser.add_argument("--source", type=Path, metavar="FILE", help="compare with the file that it was built from, too")
    parser.add_argument("--json", action="store_true", help="findings as JSON")


def run(arguments: argparse.Namespace) -> int:
    """Print every finding and a verdict.

    Raises
    ------
    InputError
        If the folder cannot be read or is not sound: one line with the first fault, and how many there are.
    """
    try:
        asset = load(arguments.folder)
    except AssetError as error:
        raise InputError(f"not sound: {error}") from None
    findings = list(check_claims(asset))
    if arguments.source is not None:
        findings += compare_with_source(asset, arguments.source)
    faults = [finding.text for finding in findings if not finding.holds and not finding.is_told]
    verdict = "not sound" if faults else "sound"
    if arguments.json:
        rows = [{"kind": one.kind, "text": one.text, "holds": one.holds, "told": one.is_told} for one in findings]
        print(json.dumps({"folder": str(asset.path), "verdict": verdict, "findings": rows}, indent=1))
    else:
        for finding in findings:
            print(f"{'ok   ' if finding.holds else 'noted' if finding.is_told else 'WRONG'} {finding.text}")
    if faults:
        more = f" (and {len(faults) - 1} more)" if len(faults) > 1 else ""
        raise InputError(f"{arguments.folder} is not sound: {faults[0][:LONGEST]}{more}: build the character again")
    if not arguments.json:
        print("sound")
    return 0


def compare_with_source(asset: Asset, file: Path) -> list[Finding]:
    """Findings about what is drawn beside what the source says; told are those that the build warned of itself.

    Raises
    ------
    InputError
        If the source cannot be read.
    """
    character = load_character(file)
    same = hash_file(file) == asset.manifest.json.get("source", {}).get("sha256")
    words = "is the file that it was built from" if same else "is not the file that it was built from"
    found = measure(asset, character)
    recorded = asset.manifest.json.get("measurements")
    findings = [
        dataclasses.replace(one, is_told=not one.is_gross and is_as_built(one.kind, found, recorded))
        for one in judge(found)
    ]
    return [Finding("source", f"{file.name} {words}", same), *findings]
