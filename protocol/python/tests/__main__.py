"""Tests of the installed wheel: every function test_* of the modules here, in order.

    python protocol/python/tests WORK     # a scratch folder; programs are in $V2VLOC_PROGRAMS
"""
import pathlib
import sys
import time

import average_precision
import data_set
import examples
import fleet
import listener
import messages

MODULES = [data_set, messages, listener, average_precision, examples]

run = fleet.Run(pathlib.Path(sys.argv[1]))
for module in MODULES:
    for name, test in list(vars(module).items()):
        if name.startswith("test_"):
            began = time.monotonic()
            test(run)
            print(f"{time.monotonic() - began:5.1f} s  {module.__name__}.{name}", file=sys.stderr, flush=True)
