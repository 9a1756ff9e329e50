"""The product unpickles nothing, runs no text as code and starts no shell, with one named exception."""

import ast
import re
from collections.abc import Iterator
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
PRODUCT = (
    "agent", "hybridmap", "mapserver", "mapweave", "merge", "registration", "sim", "storage", "vision",
    "wire",
)  # fmt: skip
UNPICKLE = {"cloudpickle", "dill", "joblib", "marshal", "pickle", "shelve"}
RUN_TEXT = {"eval", "exec"}
SHELLS = {
    "os.popen", "os.system", "asyncio.create_subprocess_shell", "subprocess.getoutput",
    "subprocess.getstatusoutput",
}  # fmt: skip
STARTS = {"Popen", "call", "check_call", "check_output", "run"}
"""Of subprocess: these take `shell`."""
ALLOWED = {("hybridmap/jit.py", "exec")}
"""A loop around a kernel: its text is a constant of the kernel's decorator, of which no input is a part."""

SUSPICIOUS = re.compile(
    "|".join(
        (*UNPICKLE, *RUN_TEXT, *(name.rpartition(".")[2] for name in SHELLS), "allow_pickle", "shell", "recv")
    )
    + r"|\bos\b[\s\\]+as\b|[^\x00-\x7f]"
)
"""Of a module without any of it nothing is forbidden, and it is not parsed: for all that takes two seconds.
Python reads some letters that are not ASCII as those that they resemble."""


def forbidden(source: str) -> Iterator[str]:
    """What of a module's source must not be in the product."""
    if not SUSPICIOUS.search(source):
        return
    for node in ast.walk(ast.parse(source)):
        match node:
            case ast.Import(names):
                yield from (one.name for one in names if one.name.partition(".")[0] in UNPICKLE)
                yield from (f"{one.name} as {one.asname}" for one in names if one.name == "os" and one.asname)
            case ast.ImportFrom(module=str(module), names=names):
                yield from (module for _ in names[:1] if module.partition(".")[0] in UNPICKLE)
                yield from (full for one in names if (full := f"{module}.{one.name}") in SHELLS)
            case ast.Name(id=name) if name in RUN_TEXT:
                yield name
            case ast.Attribute() if ast.unparse(node) in SHELLS:
                yield ast.unparse(node)
            case ast.Call(func=ast.Attribute(attr="recv"), args=[], keywords=[]):
                yield "recv() of a multiprocessing connection"
            case ast.Call(func, _, keywords):
                asked = {word.arg: ast.unparse(word.value) for word in keywords}
                starts = ast.unparse(func).rpartition(".")[2] in STARTS
                yield from ("allow_pickle" for _ in {asked.get("allow_pickle", "False")} - {"False"})
                yield from ("shell" for _ in {asked.get("shell", "False")} - {"False"} if starts)


def modules() -> list[Path]:
    """All of the product, each once: folders of `mapweave` that are links are there by themselves."""
    found = [path for folder in PRODUCT for path in (ROOT / folder).rglob("*.py")]
    return sorted({path.resolve() for path in found})


def test_the_product_has_none_of_them():
    found = {
        (str(path.relative_to(ROOT)), what)
        for path in modules()
        for what in forbidden(path.read_text(encoding="utf-8"))
    }
    assert found == ALLOWED
    assert len(modules()) > 500


def test_the_folders_are_those_of_the_package():
    linked = {path.resolve().name for path in (ROOT / "mapweave").iterdir() if path.is_symlink()}
    assert {*PRODUCT} == linked | {"mapweave"}


@pytest.mark.parametrize(("source", "what"), [
    ("import pickle", "pickle"),
    ("from pickle import loads", "pickle"),
    ("import json, marshal as m", "marshal"),
    ("def f():\n    return eval('1')", "eval"),
    ("run = exec", "exec"),
    ("import subprocess\nsubprocess.run('ls', shell=True)", "shell"),
    ("run('ls', shell=quick)", "shell"),
    ("import os\nos.system('ls')", "os.system"),
    ("from os import system", "os.system"),
    ("import os as o", "os as o"),
    ("import os\\\n as o", "os as o"),
    ("\uff45val('1')", "eval"),
    ("np.load('a.npy', allow_pickle=True)", "allow_pickle"),
    ("connection.recv()", "recv() of a multiprocessing connection"),
])  # fmt: skip
def test_each_of_them_is_found(source: str, what: str):
    assert [*forbidden(source)] == [what]


def test_what_is_alike_is_not_taken_for_one_of_them():
    calls = ("frame.eval('a')", "socket.recv(10)", "run(['ls'], shell=False)", "code(shell=name)")
    assert not [*forbidden("\n".join((*calls, "import os", "os.walk('.')")))]
