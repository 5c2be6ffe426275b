"""Every snippet of README.md and the guide runs, page by page, and gives what its comments say.

The blocks of a page run in order, in one namespace and one folder that holds a copy of examples. A comment behind a
statement that begins like a value, such as `# (480, 640, 3) uint8` or `# 1.25, in pixels`, is what the statement
must give or print. A block that does not run says so in the line above it: `<!-- not run: why -->`.
"""

from __future__ import annotations

import ast
import contextlib
import io
import os
import re
import shutil
import subprocess
import sys
import tokenize
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pytest
import torch

import fisheyerec as fr

ROOT = Path(__file__).resolve().parents[1]
PAGES = [ROOT / "README.md", *sorted((ROOT / "docs" / "guide").glob("*.md"))]

# How many blocks of each page do not run here. The README's installation is what .ci/run begins with.
NOT_RUN = {"README.md": 1, "clusters.md": 1, "cpp.md": 2, "demo.md": 1, "recover-a-lens.md": 1, "training.md": 1}

BLOCK = re.compile(r"^(?:<!-- not run: (?P<reason>[^\n]+) -->\n)?```(?P<language>\w*)\n(?P<code>.*?)^```$", re.M | re.S)
CLAIM = re.compile(r"# (?P<claim>[-(\[]*(?:\d|'|nan\b|True\b|False\b|None\b|torch\.|u?int\d).*)")
NUMBER = re.compile(r"-?\d+(?:\.\d+)?(?:e[-+]?\d+)?")


class Block(NamedTuple):
    """A snippet, and the line of its page where it begins."""

    language: str
    code: str
    line: int
    reason: str | None


def blocks_of(page: Path) -> list[Block]:
    text = page.read_text(encoding="utf-8")
    found = BLOCK.finditer(text)
    return [Block(b["language"], b["code"], text.count("\n", 0, b.start("code")) + 1, b["reason"]) for b in found]


def described(value: Any) -> str:
    """A value in the words of the comments: an array by shape and dtype, unless it is a handful of numbers."""
    if isinstance(value, torch.Size):
        return str(tuple(value))
    if isinstance(value, tuple) and any(isinstance(v, tuple | np.ndarray | torch.Tensor) for v in value):
        return ", ".join(map(described, value))
    if isinstance(value, np.ndarray | torch.Tensor):
        if 0 < (value.numel() if isinstance(value, torch.Tensor) else value.size) <= 8:
            return str(value.tolist())
        return f"{tuple(value.shape)} {str(value.dtype).removeprefix('torch.')}"
    return repr(value) if isinstance(value, str) else str(value)


def agrees(claim: str, got: str) -> bool:
    """Whether a comment says what was got: the same words, and numbers to the last digit that it has."""
    if NUMBER.split(claim) != NUMBER.split(got):
        return False
    for said, number in zip(NUMBER.findall(claim), NUMBER.findall(got), strict=True):
        mantissa, _, exponent = said.partition("e")
        unit = 10.0 ** (int(exponent or 0) - len(mantissa.partition(".")[2]))
        whole = said == str(int(float(said))) and number == str(int(float(number)))
        if abs(float(said) - float(number)) > (0 if whole else 0.501 * unit):
            return False
    return True


def check_claim(comment: str, got: str, where: str) -> None:
    """A claim may be followed by a comma, semicolon or colon and words."""
    match = CLAIM.match(comment)
    if match is None:
        return
    claim = match["claim"]
    ends = [m.start() for m in re.finditer(r"[,;:] ", claim)] + [len(claim)]
    assert any(agrees(claim[:end].strip(), got) for end in ends), f"{where}: says {claim!r}, gives {got!r}"


def comments_of(code: str) -> dict[int, str]:
    """Line -> the comment at its end."""
    tokens = tokenize.generate_tokens(io.StringIO(code).readline)
    return {t.start[0]: t.string for t in tokens if t.type == tokenize.COMMENT and t.line[: t.start[1]].strip()}


def run_python_block(block: Block, page: str, names: dict[str, Any]) -> None:
    comments = comments_of(block.code)
    for statement in ast.parse(block.code).body:
        comment = comments.get(statement.end_lineno or 0, "")
        where = f"{page}:{block.line + (statement.end_lineno or 0) - 1}"
        ast.increment_lineno(statement, block.line - 1)
        printed = io.StringIO()
        with contextlib.redirect_stdout(printed):
            if isinstance(statement, ast.Expr):
                value = eval(compile(ast.Expression(statement.value), page, "eval"), names)
            else:
                exec(compile(ast.Module([statement], []), page, "exec"), names)
                value = None
                if isinstance(statement, ast.Assign):
                    value = eval(compile(ast.Expression(_read(statement.targets[0])), page, "eval"), names)
        check_claim(comment, printed.getvalue().strip() or described(value), where)


def _read(target: ast.expr) -> ast.expr:
    """The expression that reads what was assigned."""
    return ast.parse(ast.unparse(target), mode="eval").body


def run_shell_block(block: Block, page: str, folder: Path) -> None:
    home = Path(fr.__file__).resolve().parents[1]
    environment = {
        **os.environ,
        "PATH": os.pathsep.join([str(Path(sys.executable).parent), os.environ["PATH"]]),
        "PYTHONPATH": os.pathsep.join(filter(None, [str(home), os.environ.get("PYTHONPATH")])),
        "NO_COLOR": "1",
    }
    command = ["bash", "-euo", "pipefail", "-c", block.code]
    done = subprocess.run(
        command, cwd=folder, env=environment, capture_output=True, text=True, timeout=120, check=False
    )
    assert done.returncode == 0, f"{page}:{block.line}: {block.code}\n{done.stdout}{done.stderr}"


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)
def test_snippets_run_and_give_what_they_say(page, tmp_path, monkeypatch):
    shutil.copytree(ROOT / "examples", tmp_path / "examples", ignore=shutil.ignore_patterns("__pycache__"))
    monkeypatch.chdir(tmp_path)
    names: dict[str, Any] = {"__name__": "snippet"}
    for block in blocks_of(page):
        if block.reason is not None:
            continue
        if block.language == "python":
            run_python_block(block, page.name, names)
        elif block.language == "sh":
            run_shell_block(block, page.name, tmp_path)


def test_blocks_that_do_not_run_are_few_and_known():
    skipped = {page.name: sum(block.reason is not None for block in blocks_of(page)) for page in PAGES}
    assert {name: count for name, count in skipped.items() if count} == NOT_RUN


def test_every_fence_is_a_block_of_a_known_language():
    for page in PAGES:
        fences = re.findall(r"^\s*```\w*$", page.read_text(encoding="utf-8"), re.M)
        assert len(fences) == 2 * len(blocks_of(page)), page.name
        assert {block.language for block in blocks_of(page)} <= {"python", "sh", "cpp", "cmake", "text"}, page.name


def test_blocks_of_cpp_and_cmake_are_those_of_the_example_that_is_built():
    example = "".join(path.read_text(encoding="utf-8") for path in sorted((ROOT / "examples" / "cpp").iterdir()))
    blocks = [block for page in PAGES for block in blocks_of(page) if block.language in ("cpp", "cmake")]
    assert len(blocks) == 3
    for block in blocks:
        assert block.code in example, block.code


def test_messages_that_are_explained_are_those_that_are_raised():
    page = (ROOT / "docs" / "guide" / "what-can-go-wrong.md").read_text(encoding="utf-8")
    rows = re.findall(r"^\| `(.+?)` \|", page.partition("## Messages")[2], re.M)
    assert len(rows) > 10
    home = Path(fr.__file__).parent
    # Texts without their quotes and line breaks, as the parser would join them.
    sources = [re.sub(r'"\s*f?"', "", path.read_text(encoding="utf-8")) for path in home.rglob("*.py")]
    for words in rows:
        assert any(words in source for source in sources), words


def test_there_are_snippets_and_wrong_ones_are_told():
    assert sum(len(blocks_of(page)) for page in PAGES) > 30
    for code in ("1 + 1  # 3", "x = 0.126  # 0.12, nearly", "print('b')  # 'a'", "(1, 2)  # (1, 2) uint8", "1 / 0"):
        with pytest.raises((AssertionError, ZeroDivisionError)):
            run_python_block(Block("python", code, 1, None), "page", {})
    run_python_block(Block("python", "x = 2 / 3  # 0.67, about\nprint(x)  # 0.667\nx  # as words", 1, None), "page", {})
