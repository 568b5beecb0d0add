"""Damaged files for every reader, thousands of each; a JSON line a reader.

    python benchmarks/fuzz.py [--inputs 5000] [--seed 0] [--readers ply colmap-bin]
    python benchmarks/fuzz.py --table                         # print what is there, run nothing

What is damaged, and what counts as a fault, stands in tests/support/fuzzing.py. `faults` has each one's input, so that
`python tests/support/fuzzing.py fuzz_readers READER INPUT INPUT+1 SEED` repeats it.
"""

from __future__ import annotations

import argparse
import sys
import time
from collections import Counter
from pathlib import Path

import common

sys.path.insert(0, str(common.ROOT / "tests"))

from fuzz_readers import READERS
from fuzzing import campaign

KEPT = 20  # faults of a reader that are written out; their number is whole


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--inputs", type=int, default=5000)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--readers", nargs="+", choices=list(READERS), default=list(READERS))
    parser.add_argument("--out", type=Path, default=common.RESULTS / "fuzz.jsonl")
    parser.add_argument("--table", action="store_true")
    args = parser.parse_args()
    for reader in () if args.table else args.readers:
        start = time.perf_counter()
        (result,) = campaign([reader], args.inputs, args.seed)
        common.append(
            args.out,
            {
                "reader": reader,
                "seed": args.seed,
                "inputs": result.inputs,
                "refused": result.refused,
                "faults": len(result.faults),
                "first_faults": result.faults[:KEPT],
                "seconds": round(time.perf_counter() - start, 1),
                "commit": common.commit(),
            },
        )
        for fault, times in Counter(fault["fault"] for fault in result.faults).most_common(5):
            print(f"{reader}: {times} x {fault}")
    print(f"{'reader':14} {'seed':>6} {'inputs':>8} {'refused':>8} {'faults':>7}  commit")
    for row in common.read(args.out):
        print(
            f"{row['reader']:14} {row['seed']:6d} {row['inputs']:8d} {row['refused']:8d} {row['faults']:7d}  "
            f"{row['commit']}"
        )


if __name__ == "__main__":
    main()
