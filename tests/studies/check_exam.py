"""The exam of `omnibench check`: faults injected into real recordings, and recordings without any.

    python tests/studies/check_exam.py [--seeds 1 2 3] [--robots NAME ...] [--kinds KIND ...] [--quick] [--makers]

check_exam/table.yaml says beforehand what is to be found, and what a fix has to do. Each case writes files of its own
(no code of omnibench), types `omnibench check ... --json` and then the fix as it is given. Results go to --output, a
JSON line a case; cases that stand there are not sat again (--again, --failed: they are). --makers only makes the faults
and shows that they spoil the recordings. Ends with a table of kinds by robots, the failures, and shares.
"""

from __future__ import annotations

import sys

from check_exam.exam import main

if __name__ == "__main__":
    sys.exit(main(__doc__))
