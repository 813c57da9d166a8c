#!/usr/bin/env python3
"""Time of Foreframe's networks beside onnxruntime, PyTorch and published networks, on one core.

Usage: run.py [--programs target/release/deps] [--rounds 5] [--core 0]

`cargo bench --bench model --bench flow --no-run` builds the programs; README.md in this directory says more.
"""

from __future__ import annotations

import argparse
import os
import sys
from pathlib import Path
from statistics import median

ROOT = Path(__file__).resolve().parents[2]
# One thread each: before the libraries start theirs.
for variable in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS", "RAYON_NUM_THREADS"):
    os.environ[variable] = "1"
sys.path.insert(0, str(ROOT / "python" / "src"))

import cases  # noqa: E402
import runners  # noqa: E402

COLUMNS = ["Foreframe", "onnxruntime", "PyTorch"]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--programs", type=Path, default=ROOT / "target/release/deps", help="directory of the built benches")
    parser.add_argument("--rounds", type=int, default=5, help="alternating rounds; medians are printed")
    parser.add_argument("--core", type=int, default=0, help="the core that everything runs on")
    arguments = parser.parse_args()
    os.sched_setaffinity(0, {arguments.core})

    ours = runners.Foreframe(arguments.programs, ROOT)
    all_cases = cases.all_cases(ROOT / "models")
    others = {"onnxruntime": runners.onnxruntime_runner, "PyTorch": runners.torch_runner()}
    if others["PyTorch"] is None:
        print("PyTorch is not installed (pip install torch): its column stays empty\n", file=sys.stderr)
    calls = {
        (case, name): runner(case.model, case.inputs())
        for case in all_cases
        for name, runner in others.items()
        if runner is not None
    }
    for case in all_cases:
        # What is timed computes the same.
        outputs = [call() for (of, _), call in calls.items() if of is case]
        if any(runners.difference(outputs[0], other) > 1e-3 for other in outputs[1:]):
            raise SystemExit(f"{case.title}: PyTorch and onnxruntime predict different frames")
    products = runners.products()
    times: dict[tuple[cases.Case, str], list[float]] = {}
    rates: dict[str, list[float]] = {}
    for number in range(arguments.rounds):
        print(f"round {number + 1} of {arguments.rounds}", file=sys.stderr)
        measured = ours.round()
        for case in all_cases:
            if case.bench is not None:
                if case.bench not in measured:
                    raise SystemExit(f"the benches print no line `{case.bench}`; build them again from this tree")
                times.setdefault((case, "Foreframe"), []).append(measured[case.bench])
            for name in others:
                if (case, name) in calls:
                    times.setdefault((case, name), []).append(runners.milliseconds(calls[case, name]))
        for name, product in products.items():
            rates.setdefault(name, []).append(runners.product_gflops(product))
    report(all_cases, times, rates)


def report(all_cases: list[cases.Case], times: dict[tuple[cases.Case, str], list[float]], rates: dict[str, list[float]]) -> None:
    """Prints the medians as two tables."""
    peak = max(median(found) for found in rates.values())
    print(", ".join(f"{name} {median(found):.0f} GFLOP/s" for name, found in rates.items()), "in a product of matrices")
    print(f"the peak, of which shares are given: {peak:.0f} GFLOP/s\n")
    print("| Milliseconds |", " | ".join(COLUMNS), "| onnxruntime / Foreframe | PyTorch / Foreframe | Share of the peak, each |")
    print("| --- |" + " ---: |" * (len(COLUMNS) + 3))
    for case in all_cases:
        found = {name: median(times[case, name]) for name in COLUMNS if (case, name) in times}
        cells = [f"{found[name]:.2f}" if name in found else "–" for name in COLUMNS]
        for name in COLUMNS[1:]:
            is_known = "Foreframe" in found and name in found
            cells.append(f"{found[name] / found['Foreframe']:.2f}" if is_known else "–")
        shares = [2e-6 * case.multiply_adds / found[name] / peak if name in found else None for name in COLUMNS]
        cells.append(" / ".join("–" if share is None else f"{share:.0%}" for share in shares))
        print(f"| {case.title} |", " | ".join(cells), "|")
    spread = max((max(found) - min(found)) / median(found) for found in times.values())
    print(f"\nrounds of one case differ by up to {spread:.0%} of their median")


if __name__ == "__main__":
    main()
