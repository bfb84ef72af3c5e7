"""The house is in order: lint, types, import contracts, a light import, nothing of one machine."""

import json
import re
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parent.parent
TOOLS = Path(sys.executable).parent
HEAVY = ("jax", "jaxlib", "numba", "llvmlite", "trimesh", "scipy", "networkx")
FOREIGN = re.compile(
    r"(?<![\w.])/(home|root|Users|work|tmp|var|mnt|media)/[\w.]"  # a place on one machine
    r"|[A-Z]:\\\\?Users"
    r"|\b(pypi\.org|pythonhosted\.org|npmjs\.(com|org)|crates\.io)\b"  # a package registry
)


def run_tool(name: str, *arguments: str) -> None:
    tool = shutil.which(name, path=str(TOOLS)) or shutil.which(name)
    if tool is None:
        pytest.fail(f"{name} is not installed: install the extra dev")
    done = subprocess.run(
        [tool, *arguments], cwd=ROOT, capture_output=True, text=True, check=False, timeout=300
    )
    assert done.returncode == 0, done.stdout + done.stderr


def tracked_files() -> list[Path]:
    git = shutil.which("git")
    if git is None or not (ROOT / ".git").exists():
        pytest.skip("not a git checkout")
    listed = subprocess.run(
        [git, "ls-files", "-z"], cwd=ROOT, capture_output=True, text=True, check=True
    ).stdout
    return [ROOT / name for name in listed.split("\0") if name and (ROOT / name).is_file()]


def test_lint() -> None:
    run_tool("ruff", "check", ".")


def test_formatting() -> None:
    run_tool("ruff", "format", "--check", ".")


def test_types() -> None:
    run_tool("basedpyright", "--pythonpath", sys.executable)


def test_import_contracts() -> None:
    run_tool("lint-imports")


def test_import_is_light() -> None:
    script = "import json, sys, striptools; print(json.dumps(sorted(sys.modules)))"
    done = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, check=True)
    assert not set(json.loads(done.stdout)) & set(HEAVY)


def test_conversion_needs_no_jax() -> None:
    script = "import sys, striptools; striptools.convert; striptools.open; assert 'jax' not in sys.modules"
    subprocess.run([sys.executable, "-c", script], check=True)


def test_public_names_exist() -> None:
    import striptools

    assert all(hasattr(striptools, name) for name in striptools.__all__)
    with pytest.raises(AttributeError, match="no attribute 'nothing'"):
        _ = striptools.nothing


def test_nothing_of_one_machine_is_tracked() -> None:
    found = []
    for path in tracked_files():
        try:
            text = path.read_text(encoding="utf-8")
        except UnicodeDecodeError:
            continue
        if path != Path(__file__):
            found += [f"{path.relative_to(ROOT)}: {match[0]}" for match in FOREIGN.finditer(text)]
    assert not found


@pytest.mark.parametrize("line", ["see /home/anna/x.ply", "= '/tmp/out'", "https://pypi.org/simple"])
def test_the_search_for_machine_paths_finds_them(line: str) -> None:
    assert FOREIGN.search(line)


def test_ci_runs_the_commands_of_the_readme() -> None:
    readme = (ROOT / "README.md").read_text()
    commands = [line.strip() for line in readme.splitlines() if line.strip().startswith("python3.11 -m venv")]
    assert len(commands) == 2, "the README has two commands for a fresh machine"
    assert commands[0].endswith("samples/first_scene.py")
    ci = (ROOT / ".ci" / "run").read_text().splitlines()
    assert "set -euo pipefail" in ci
    assert ci[-1] == commands[1]
    assert commands[1] in (ROOT / "CONTRIBUTING.md").read_text()
    assert (ROOT / ".ci" / "run").stat().st_mode & 0o111


def test_only_kernels_call_what_python_cannot():
    """A helper has no wrapper: Python that calls it, or imports it to do so, would crash."""
    hidden = {}
    for file in (ROOT / "striptools" / "kernels").glob("*.py"):
        found = re.findall(r"^@(maker|helper|inlined|spliced)\ndef (\w+)", file.read_text(), re.MULTILINE)
        hidden[file.stem] = {name for _, name in found}
    assert sum(map(len, hidden.values())) > 20
    callers = [file for folder in ("striptools", "cli", "samples") for file in (ROOT / folder).rglob("*.py")]
    for file in callers:
        if file.parent.name != "kernels":
            assert not _hidden_names(file.read_text(), hidden), file


def _hidden_names(text: str, hidden: dict[str, set[str]]) -> set[str]:
    """The hidden kernels that a module imports by name or takes from a module of kernels."""
    found = set()
    for module, names in re.findall(r"from striptools\.kernels\.(\w+) import \(?([\w\s,]+)", text):
        found |= hidden.get(module, set()) & set(re.findall(r"\w+", names))
    for module, alias in re.findall(r"from striptools\.kernels import (\w+)(?: as (\w+))?", text):
        used = set(re.findall(rf"\b{alias or module}\.(\w+)", text))
        found |= hidden.get(module, set()) & used
    return found


def test_a_hidden_kernel_is_found():
    hidden = {"boxes": {"grow"}}
    assert _hidden_names("from striptools.kernels.boxes import area, grow\n", hidden) == {"grow"}
    assert _hidden_names("from striptools.kernels import boxes as b\nb.grow(1)\n", hidden) == {"grow"}
    assert not _hidden_names("from striptools.kernels import boxes\nboxes.area(1)\n", hidden)
