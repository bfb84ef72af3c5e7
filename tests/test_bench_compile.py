"""The bench of compilation names functions that run, and a second process takes programs from the cache."""

import sys
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parent / "benches"))
import bench_compile as bench


def test_a_second_process_does_not_compile_again() -> None:
    first, second = bench.pair("closest hit in packets, expanded")
    # The walk in packets, and that of rays that find no company.
    assert (first["kept"], second["kept"]) == (0, 2)
    assert second["longest"] < first["longest"]


def test_the_least_of_several_runs_counts() -> None:
    stages = dict.fromkeys(bench.STAGES.values(), 1.0)
    found = bench.least((stages | {"kept": 2.0}, stages | {"compile": 3.0, "trace": 0.5, "kept": 1.0}))
    assert (found["all"], found["compile"], found["trace"], found["kept"]) == (3.0, 1.0, 0.5, 1.0)


def test_functions_have_names_and_run() -> None:
    calls = bench.calls()
    assert {"closest hit, expanded", "any hit, compressed", "functional closest hit, gradient"} <= set(calls)
    calls["count hits, expanded"]()
