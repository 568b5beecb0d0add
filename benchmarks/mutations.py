"""Single wrong changes of the sources, and the share of them that the tests notice.

    python benchmarks/mutations.py [--only ID ...] [--resume] [--all-tests]
    python benchmarks/mutations.py --check                    # all changes still apply; runs no test
    python benchmarks/mutations.py --table                    # print the stored results, run nothing

benchmarks/mutation_tables/*.toml lists the changes and the tests that are likely to notice them. Each change is made in
a scratch copy of the repository. If the named tests pass, the other tests of the package run, and with --all-tests the
whole default suite. A test that fails counts only if it passes without the change. A change that no test can notice is
marked as equivalent, with the reason, and is not counted. Results are stored after each change, so --resume goes on
after an interruption, and runs again only the changes whose text is new.
"""

from __future__ import annotations

import json
import shlex
import sys
import tempfile
from dataclasses import asdict
from pathlib import Path

import common

sys.path.extend(common.TEST_HELPERS)

from mutating import (
    CAUGHT,
    SURVIVED,
    TIMEOUT,
    Laboratory,
    Mutation,
    Result,
    ScratchCopy,
    WarmPytest,
    faults_of,
    read_tables,
    share_caught,
)

OUT = common.RESULTS / "mutations.json"


def main() -> None:
    parser = common.parser(__doc__, OUT, device=False, smoke=False)
    parser.add_argument(
        "--only", nargs="+", metavar="ID", help="run only these mutations, and keep the results of the others"
    )
    parser.add_argument("--all-tests", action="store_true", help="run the whole default suite on survivors")
    parser.add_argument(
        "--resume", action="store_true", help="keep the results in --out of mutations that are the same"
    )
    parser.add_argument("--narrow", action="store_true", help="run only the tests that the tables name")
    parser.add_argument("--timeout", type=float, default=TIMEOUT, help="seconds of one test run")
    parser.add_argument("--again", action="store_true", help="with --resume: run the stored survivors once more")
    parser.add_argument("--check", action="store_true", help="only check that all mutations apply")
    parser.add_argument(
        "--prefix",
        default="",
        metavar="COMMAND",
        help="a command whose process lives during a test run, e.g. one that waits for its turn",
    )
    args = parser.parse_args()
    mutations = read_tables()
    faults = faults_of(mutations)
    for fault in faults:
        print(fault, file=sys.stderr)
    if args.check:
        print(f"{len(mutations)} mutations, {len(faults)} faults")
        sys.exit(bool(faults))
    if unknown := set(args.only or ()) - {mutation.id for mutation in mutations}:
        sys.exit(f"no mutation is called {', '.join(sorted(unknown))}")
    stored = read_results(args.out) if args.resume or args.table or args.only else {}
    if not args.table:
        kept = {
            mutation.id: stored[mutation.id]
            for mutation in mutations
            if mutation.id in stored
            and stored[mutation.id].digest == mutation.digest
            and mutation.id not in (args.only or ())
            and not (args.again and stored[mutation.id].outcome == SURVIVED)
        }
        due = [
            mutation
            for mutation in mutations
            if mutation.id not in kept and mutation.id in (args.only or [mutation.id])
        ]
        with tempfile.TemporaryDirectory(prefix="clsplat-mutations-") as folder:
            pytest = WarmPytest(Path(folder), shlex.split(args.prefix), args.timeout)
            copy = ScratchCopy(Path(folder), pytest)
            run_all(Laboratory(copy, not args.narrow, args.all_tests), due, kept, mutations, args.out)
            pytest.close()
        stored = kept
    print(report(mutations, stored))


def run_all(
    laboratory: Laboratory, due: list[Mutation], results: dict[str, Result], mutations: list[Mutation], out: Path
) -> None:
    """Run mutations, add their results to `results`, and write all of them after each one."""
    for number, mutation in enumerate(due, 1):
        try:
            result = laboratory.run(mutation)
        except ValueError as error:
            print(f"[{number}/{len(due)}] {error}", file=sys.stderr, flush=True)
            continue
        results[mutation.id] = result
        seen = f"{result.outcome} {result.by}".strip()
        print(f"[{number}/{len(due)}] {mutation.id}: {seen} ({result.seconds:.0f} s)", flush=True)
        write_results(out, [results[m.id] for m in mutations if m.id in results])


def read_results(path: Path) -> dict[str, Result]:
    """Return the stored results by the name of the mutation."""
    if not path.is_file():
        return {}
    return {entry["id"]: Result(**entry) for entry in json.loads(path.read_text(encoding="utf-8"))["results"]}


def write_results(path: Path, results: list[Result]) -> None:
    """Store results, and the commit that they were measured on."""
    caught, real = share_caught(results)
    head = {"commit": common.commit(), "caught": caught, "real": real}
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(
        json.dumps(head | {"results": [asdict(result) for result in results]}, indent=1) + "\n", encoding="utf-8"
    )


def report(mutations: list[Mutation], stored: dict[str, Result]) -> str:
    """Return a table by package, and the survivors with their meaning."""
    rows = []
    packages = dict.fromkeys(mutation.package for mutation in mutations)
    for package in (*packages, "all"):
        group = [m for m in mutations if package in (m.package, "all")]
        results = [stored[m.id] for m in group if m.id in stored]
        caught, real = share_caught(results)
        share = f"{100 * caught / real:.1f} %" if real else ""
        rows.append((package, len(group), len(results) - real, real, caught, share))
    lines = [common.table(("package", "mutations", "equivalent", "real", "caught", "share"), rows), ""]
    for mutation in mutations:
        result = stored.get(mutation.id)
        if result is not None and result.outcome != CAUGHT:
            what = f"{mutation.means} ({mutation.file})"
            lines.append(
                f"- {result.outcome}: {mutation.id}: {what}" + f": {mutation.equivalent}" * bool(mutation.equivalent)
            )
    left = sum(mutation.id not in stored for mutation in mutations)
    lines += [f"- not run yet: {left}"] if left else []
    return "\n".join(lines)


if __name__ == "__main__":
    main()
