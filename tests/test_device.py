"""Flags, devices and caches: the user's own are kept, and the user is told what is slow."""

import os
import subprocess
import sys
from pathlib import Path

import pytest

from striptools.errors import MissingExtraError, UsageError
from striptools.trace import device
from striptools.trace.device import LOOP_LIMIT, LOOP_OPTION, core_count, hoist_loops, with_loop_option

OPTION = f"{LOOP_OPTION}={LOOP_LIMIT}"


@pytest.mark.parametrize(
    ("before", "after"),
    [
        ("", f"--xla_backend_extra_options={OPTION}"),
        ("--xla_a=1  --b='x y'", f"--xla_a=1  --b='x y' --xla_backend_extra_options={OPTION}"),
        ("--xla_backend_extra_options=a=b --c", f"--xla_backend_extra_options=a=b,{OPTION} --c"),
        ("--xla_backend_extra_options=", f"--xla_backend_extra_options={OPTION}"),
        (f"--xla_backend_extra_options={LOOP_OPTION}=5", f"--xla_backend_extra_options={LOOP_OPTION}=5"),
    ],
)
def test_flags_of_the_user_are_kept(before, after):
    assert with_loop_option(before) == after
    assert with_loop_option(after) == after


def test_a_file_of_flags_is_taken_over(tmp_path):
    path = tmp_path / "flags"
    path.write_text("--xla_a=1\n--xla_b=2\n")
    environ = {"XLA_FLAGS": str(path)}
    assert not hoist_loops(environ)
    assert environ["XLA_FLAGS"] == f"--xla_a=1 --xla_b=2 --xla_backend_extra_options={OPTION}"
    assert hoist_loops(environ)


def test_a_file_of_flags_that_is_not_there_is_an_error(tmp_path):
    with pytest.raises(UsageError, match="XLA_FLAGS"):
        hoist_loops({"XLA_FLAGS": str(tmp_path / "none")})


def test_thread_count_comes_from_the_environment():
    assert core_count({"STRIPTOOLS_THREADS": "3"}) == 3
    assert core_count({}) >= 1
    for wrong in ("0", "-1", "two", "1.5"):
        with pytest.raises(UsageError, match="STRIPTOOLS_THREADS"):
            core_count({"STRIPTOOLS_THREADS": wrong})


def test_cache_is_left_out_where_there_is_no_place_for_it(tmp_path):
    file = tmp_path / "file"
    file.write_text("")
    assert device.cache_folder({"XDG_CACHE_HOME": str(file)}) is None
    folder = device.cache_folder({"XDG_CACHE_HOME": str(tmp_path)})
    assert folder is not None
    assert folder.is_dir()


def test_unknown_devices_and_thread_counts_are_refused():
    with pytest.raises(UsageError, match="no such device"):
        device.trace_devices("tpu", None)  # pyright: ignore[reportArgumentType]
    with pytest.raises(UsageError, match="threads"):
        device.trace_devices("cpu", 0)
    assert len(device.trace_devices("cpu", 1)) == 1


def run_python(code, **environ):
    """Run code in a process of its own, every warning an error unless the code says else."""
    return subprocess.run(
        [sys.executable, "-W", "error", "-c", code],
        capture_output=True,
        text=True,
        env={
            **{k: v for k, v in os.environ.items() if k not in ("XLA_FLAGS", "STRIPTOOLS_THREADS")},
            **environ,
        },
        cwd=Path(__file__).parent,
        check=False,
    )


def test_import_prepares_jax_quietly(tmp_path):
    code = (
        "import os, striptools.trace, jax\n"
        f"assert {OPTION!r} in os.environ['XLA_FLAGS']\n"
        "assert os.environ['XLA_FLAGS'].startswith('--xla_cpu_enable_fast_math=false ')\n"
        "assert jax.device_count('cpu') == 3\n"
        "assert 'striptools' in jax.config.jax_compilation_cache_dir\n"
    )
    done = run_python(
        code,
        XLA_FLAGS="--xla_cpu_enable_fast_math=false",
        STRIPTOOLS_THREADS="3",
        XDG_CACHE_HOME=str(tmp_path),
    )
    assert (done.returncode, done.stderr) == (0, "")


def test_the_users_own_settings_of_jax_win(tmp_path):
    code = (
        "import jax\n"
        f"jax.config.update('jax_compilation_cache_dir', {str(tmp_path)!r})\n"
        "jax.config.update('jax_num_cpu_devices', 4)\n"
        "import striptools.trace\n"
        f"assert jax.config.jax_compilation_cache_dir == {str(tmp_path)!r}\n"
        "assert jax.device_count('cpu') == 4\n"
    )
    done = run_python(code)
    assert (done.returncode, done.stderr) == (0, "")


def test_a_running_backend_is_told_once():
    code = (
        "import warnings, jax\n"
        "jax.devices()\n"
        "with warnings.catch_warnings(record=True) as told:\n"
        "    warnings.simplefilter('always')\n"
        "    import striptools.trace\n"
        "assert [w.category.__name__ for w in told] == ['SlowTracingWarning'], told\n"
    )
    done = run_python(code)
    assert (done.returncode, done.stderr) == (0, "")


def test_missing_jax_names_the_extra(monkeypatch):
    monkeypatch.setitem(sys.modules, "jax", None)
    with pytest.raises(MissingExtraError, match=r"striptools\[trace\]"):
        device.prepare_jax({})
