"""Entry point of `python -m preprocess`."""

import os
import sys
import threading

from preprocess.cli import main

if __name__ == "__main__":
    status = main(sys.argv[1:])
    if threading.active_count() > 1:  # a stage that was stopped has threads that may go on for minutes
        sys.stdout.flush()
        sys.stderr.flush()
        os._exit(status)
    sys.exit(status)
