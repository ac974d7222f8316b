"""What `./run demo` does: builds the built-in character, runs the pipeline on it and writes pictures to out/demo/.

Every step is skipped while nothing that it is made from has changed, so a second run takes a second or two.

    python -m demos.gallery [--force] [--out DIR]
"""

from __future__ import annotations

import hashlib
import html
import json
import sys
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path

from demos.errors import DemoError
from demos.options import Parser, run

ROOT = Path(__file__).resolve().parent.parent
STAMPS = "stamps.json"


@dataclass
class Step:
    """Something to make.

    Attributes
    ----------
    name : str
        What is said while it runs.
    results : tuple of Path
        What it writes: files and folders.
    sources : tuple of str
        Patterns of files of this checkout that decide the result, and results of earlier steps.
    make : function without arguments
    after : list of Step
        Whose results it needs.
    """

    name: str
    results: tuple[Path, ...]
    sources: tuple[str, ...]
    make: Callable[[], None]
    after: list[Step] = field(default_factory=list)

    def stamp(self) -> str:
        """Hash of everything that the result is made from."""
        digest = hashlib.sha256(f"{self.name} {[path.name for path in self.results]}".encode())
        for earlier in self.after:
            digest.update(earlier.stamp().encode())
        for pattern in self.sources:
            for path in sorted(path for path in ROOT.glob(pattern) if path.is_file()):
                digest.update(path.relative_to(ROOT).as_posix().encode() + b"\0" + path.read_bytes())
        return digest.hexdigest()


def run_steps(steps: Sequence[Step], folder: Path, force: bool) -> None:
    """Make what is missing or out of date, in order, saying so."""
    stamp_file = folder / STAMPS
    stamps: dict[str, str] = {}
    if stamp_file.is_file() and not force:
        try:
            stamps = dict(json.loads(stamp_file.read_bytes()))
        except (ValueError, TypeError):  # cut short: everything is made again
            stamps = {}
    for step in steps:
        stamp = step.stamp()
        if stamps.get(step.name) == stamp and all(path.exists() for path in step.results):
            print(f"  {step.name}: up to date")
            continue
        print(f"  {step.name} ...", flush=True)
        start = time.perf_counter()
        stamps.pop(step.name, None)
        step.make()
        stamps[step.name] = stamp
        stamp_file.write_text(json.dumps(stamps, indent=1) + "\n")
        print(f"  {step.name}: {time.perf_counter() - start:.1f} s", flush=True)


def make_creature(path: Path) -> None:
    """Write the built-in character's file."""
    from demos.creature.build import build_creature

    build_creature(path)


def make_folder(model: Path, folder: Path) -> None:
    """Run the pipeline at default settings.

    Raises
    ------
    DemoError
        If the pipeline refuses the file.
    """
    from preprocess.errors import InputError
    from preprocess.pipeline import build
    from preprocess.progress import Progress
    from preprocess.settings import Settings

    try:
        result = build(model, folder, Settings(report=True), Progress())
    except InputError as error:
        raise DemoError(str(error)) from None
    for warning in result.warnings:
        print(f"    note: {warning}")


# File, heading and explanation of each picture, in the order of the page.
PICTURES: tuple[tuple[str, str, str], ...] = (
    ("hero.png", "The built-in character", "Modelled, unwrapped, painted and animated by code. Drawn from textures."),
    ("levels.png", "Levels of detail", "The same textures at every level. The mesh below is all that changes."),
    ("distance.png", "Chosen by projected error", "Each at the coarsest level whose error stays under a pixel."),
    ("crowd.png", "By the hundred", "800 of them from the same few textures, every one in a moment of its own."),
    ("walk.png", "Walk", "One cycle; feet that stand do not slide."),
    ("greet.png", "Greet", "Sitting up and waving."),
    ("seam.png", "A seam, before and after", "Left as a plain bake leaves it, right erased and owned."),
    ("views.png", "What the textures hold", "Base colour, normal, position, weights: all fetched by uv."),
    ("wireframe.png", "Wireframe and seams", "The finest level, and where the atlas is cut."),
    ("atlas.png", "The atlas", "Base colour with the outlines of the charts, as stored: seams meet texel by texel."),
)


def write_page(folder: Path, built: Path) -> None:
    """index.html, with every picture and the figures of the build."""
    manifest = json.loads((built / "manifest.json").read_bytes())
    faces = " → ".join(f"{level['faces']:,}" for level in manifest["lods"])
    rows = "".join(
        f"<tr><td>{html.escape(name)}</td><td>{entry['size'][0]} × {entry['size'][1]}</td><td>{entry['format']}</td>"
        f"<td>{entry['seam']['before']['rms']:.2e} / {entry['seam']['before']['max']:.2e}</td>"
        f"<td>{entry['seam']['stored'][0]['rms']:.2e} / {entry['seam']['stored'][0]['max']:.2e}</td></tr>"
        for name, entry in manifest["textures"].items()
    )
    figures = "".join(
        f'<figure id="{Path(file).stem}"><h2>{html.escape(title)}</h2><a href="{file}"><img src="{file}" '
        f'alt="{html.escape(title)}" loading="lazy"></a><figcaption>{html.escape(text)}</figcaption></figure>'
        for file, title, text in PICTURES
    )
    atlas = manifest["atlas"]
    report = '<p><a href="creature.seamless/report.html">The build\'s report</a></p>'
    page = f"""<!doctype html>
<html lang="en"><head><meta charset="utf-8"><meta name="viewport" content="width=device-width, initial-scale=1">
<title>seamskin: the built-in character</title>
<style>
body {{ margin: 0 auto; max-width: 1200px; padding: 1.5rem; font: 16px/1.5 system-ui, sans-serif; color: #22262e;
       background: #f2f3f5 }}
figure {{ margin: 2rem 0 }} img {{ max-width: 100%; border-radius: 6px; display: block }}
figcaption {{ color: #5a616e; margin-top: .4rem }} h1, h2 {{ font-weight: 600; margin: .4rem 0 }}
table {{ border-collapse: collapse }} td, th {{ padding: .2rem .9rem .2rem 0; text-align: left }}
</style></head><body>
<h1>seamskin: the built-in character</h1>
<p>{manifest["lods"][0]["faces"]:,} triangles, {len(manifest["joints"])} joints, {atlas["charts"]} charts
({html.escape(str(atlas["mode"]))}). Levels of detail: {faces} faces.</p>
<table><tr><th>texture</th><th>size</th><th>stored as</th><th>jump across seams before, rms / max</th>
<th>as stored, rms / max</th></tr>{rows}</table>
<p>Jumps are in units of a texture's range, for the position in metres; an 8-bit step is {1 / 255:.2e}.</p>
{report if (built / "report.html").is_file() else ""}
{figures}
</body></html>
"""
    (folder / "index.html").write_text(page, encoding="utf-8")


def make_pictures(model: Path, built: Path, folder: Path) -> None:
    """Draw everything in PICTURES, and the page that shows them."""
    from demos.gallery_pictures import draw_pictures

    draw_pictures(model, built, folder)
    write_page(folder, built)


def plan(folder: Path) -> list[Step]:
    """The three steps: character, pipeline, pictures."""
    model, built = folder / "creature.glb", folder / "creature.seamless"
    creature = Step("character", (model,), ("demos/creature/*.py",), lambda: make_creature(model))
    pipeline = Step(
        "pipeline",
        (built / "manifest.json",),
        (
            "preprocess/**/*.py",
            "runtime/gltf/*.py",
            "runtime/animation/*.py",
            "runtime/asset/*.py",
        ),
        lambda: make_folder(model, built),
        [creature],
    )
    pictures = Step(
        "pictures",
        (folder / "index.html", *(folder / file for file, _, _ in PICTURES)),
        ("demos/*.py", "runtime/*.py", "shaders/**/*"),
        lambda: make_pictures(model, built, folder),
        [pipeline],
    )
    return [creature, pipeline, pictures]


def this_python() -> str:
    """How to call this Python from the folder one is in: its virtual environment need not be active."""
    program = Path(sys.executable)
    here = Path.cwd()
    return str(program.relative_to(here)) if program.is_relative_to(here) else program.name


def main(arguments: Sequence[str] | None = None) -> int:
    """Entry of `./run demo`."""
    from preprocess.numerics.compile_progress import compile_quickly

    compile_quickly()

    def work() -> None:
        parser = Parser("python -m demos.gallery", description="Build the built-in character and draw it.")
        parser.add_argument("--out", type=Path, default=Path("out/demo"), metavar="DIR", help="(out/demo)")
        parser.add_argument("--force", action="store_true", help="make everything again")
        options = parser.parse_args(arguments)
        try:
            options.out.mkdir(parents=True, exist_ok=True)
        except OSError as error:
            raise DemoError(f"cannot make {options.out}: {error.strerror}") from None
        print(f"pictures of the built-in character → {options.out}")
        run_steps(plan(options.out), options.out, options.force)
        print(f"open {options.out / 'index.html'}   or   {this_python()} -m demos.viewer")

    return run("demo", work)


if __name__ == "__main__":
    sys.exit(main())
