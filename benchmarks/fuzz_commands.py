"""Random command lines for every command, over intact and damaged files; a JSON line a campaign.

    python benchmarks/fuzz_commands.py [--lines 5000] [--seed 0] [--workers 2]
    python benchmarks/fuzz_commands.py --table                # print the finished campaigns, run nothing

tests/support/command_lines.py makes the lines, and tests/support/command_fuzz.py defines what counts as a fault.
`python tests/support/command_fuzz.py --show NUMBER SEED [DATA]` repeats a line.
"""

from __future__ import annotations

import sys
import time
from collections import Counter

import common

sys.path.extend(common.TEST_HELPERS)

from command_fuzz import ROOM, SECONDS, run_lines

KEPT = 20  # lines with faults that are written; all of them are counted
COLUMNS = ("seed", "lines", "succeeded", "refused", "usage", "interrupted", "faults", "most_megabytes", "commit")


def main() -> None:
    parser = common.parser(__doc__, common.RESULTS / "fuzz_commands.jsonl", device=False, smoke=False)
    parser.add_argument("--lines", type=int, default=5000)
    parser.add_argument("--first", type=int, default=0, help="number of the first line")
    parser.add_argument("--step", type=int, default=1, help="run each STEP-th line only")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--workers", type=int, default=2)
    args = parser.parse_args()
    if not args.table:
        start, outcomes = time.perf_counter(), []
        data = common.data_folder()
        numbers = range(args.first, args.first + args.lines, args.step)
        for outcome in run_lines(numbers, args.seed, args.workers, data):
            outcomes.append(outcome)
            if outcome.faults:
                print(f"line {outcome.number} (seed {args.seed}): {outcome.args}: {outcome.faults}", flush=True)
            if len(outcomes) % 250 == 0:
                print(f"{len(outcomes)} lines", file=sys.stderr, flush=True)
        codes = Counter(outcome.code for outcome in outcomes if not outcome.interrupted)
        faulty = [outcome for outcome in outcomes if outcome.faults]
        by_command = Counter(outcome.command for outcome in outcomes)
        common.append(
            args.out,
            {
                "seed": args.seed,
                "first": args.first,
                "step": args.step,
                "lines": len(outcomes),
                "succeeded": codes[0],
                "refused": codes[1],
                "usage": codes[2],
                "interrupted": sum(outcome.interrupted for outcome in outcomes),
                "faults": len(faulty),
                "first_faults": [[outcome.number, outcome.args, outcome.faults] for outcome in faulty[:KEPT]],
                "by_command": dict(by_command.most_common()),
                "most_megabytes": max(outcome.megabytes for outcome in outcomes),
                "address_limit_megabytes": ROOM >> 20,
                "longest_seconds": max(outcome.seconds for outcome in outcomes),
                "limit_seconds": SECONDS,
                "seconds": round(time.perf_counter() - start, 1),
                "commit": common.commit(),
            },
        )
    print(common.table(COLUMNS, [[row[name] for name in COLUMNS] for row in common.read(args.out)]))


if __name__ == "__main__":
    main()
