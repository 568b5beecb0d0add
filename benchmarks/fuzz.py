"""Damaged files for every reader, thousands of each; a JSON line a reader.

    python benchmarks/fuzz.py [--inputs 5000] [--seed 0] [--readers ply colmap-bin]
    python benchmarks/fuzz.py --table                         # print the finished campaigns, run nothing

tests/support/fuzzing.py defines how files are damaged and what counts as a fault. `faults` holds the input of each
fault, so that `python tests/support/fuzzing.py fuzz_readers READER INPUT INPUT+1 SEED` repeats it.
"""

from __future__ import annotations

import sys
import time
from collections import Counter

import common

sys.path.extend(common.TEST_HELPERS)

from fuzz_readers import READERS
from fuzzing import campaign

KEPT = 20  # faults of a reader whose inputs are written; all of them are counted
COLUMNS = ("reader", "seed", "inputs", "refused", "faults", "commit")


def main() -> None:
    parser = common.parser(__doc__, common.RESULTS / "fuzz.jsonl", device=False, smoke=False)
    parser.add_argument("--inputs", type=int, default=5000)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--readers", nargs="+", choices=list(READERS), default=list(READERS))
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
    print(common.table(COLUMNS, [[row[name] for name in COLUMNS] for row in common.read(args.out)]))


if __name__ == "__main__":
    main()
