"""What README and docs tell a reader to type is there: commands and options, Python, files and headings."""

from __future__ import annotations

import ast
import importlib
import inspect
import re
import runpy
import shlex
import sys
from pathlib import Path

import numpy as np
import pytest

import envs.command
from worldmodel.train import main as train
from worldmodel.train import parse_options

ROOT = Path(__file__).parents[1]
DOCUMENTS = sorted(path.relative_to(ROOT).as_posix() for path in (ROOT / "README.md", *(ROOT / "docs").glob("*.md")))
SCRIPTS = dict(re.findall(r'^([\w-]+) = "([\w.]+:\w+)"$', (ROOT / "pyproject.toml").read_text(), re.MULTILINE))
MODULES = ("planning.foresight", "planning.tracking_error", "tests.benchmarks", "tests.endurance.precision")
PACKAGES = ("envs", "data_collection", "worldmodel", "planning", "tests")
OTHERS = {"source", "pip", "make", "sudo", "export", "rerun", "ray", "cat"}
OTHERS_OPTIONS = {"--no-deps", "--max-restarts", "--shutdown-timeout"}  # of pip, torchrun
SHORTENED = {  # what a command takes that a mention in a sentence, or one with "...", may leave out
    "collect-rollouts": ("--out",),
    "train-worldmodel": ("--data", "--out"),
    "worldmodel.train": ("--data", "--out"),
    "tune-worldmodel": ("--data", "--out"),
    "evaluate-worldmodel": ("--data",),
    "view-prediction": ("--data", "--out"),
    "run-study": ("--train", "--validation", "--test", "--out"),
    "train-policy": ("--out",),
    "planning.foresight": ("--checkpoint",),
    "data_collection.hand_pictures": ("--data", "--out"),
}
VALUES = {"--out": "x.png"}
PLACEHOLDERS = {"M": "1", "N": "1", "S": "1", "GB": "1"}
FILES = ("FILE", "runs/tuned/best.json")  # that commands read their options from
NOT_INSTALLED = ("stable_worldmodel",)
RUN = {
    "README.md": (0, "range(100)", "range(1)"),
    "docs/environments.md": (0, "", ""),
    "docs/planning.md": (1, "range(100)", "range(1)"),
}


class Parsed(Exception):
    """The options were understood."""


def fences(document: str, language: str) -> list[str]:
    return re.findall(rf"^```{language}\n(.*?)^```$", (ROOT / document).read_text(), re.MULTILINE | re.DOTALL)


def prose(document: str) -> str:
    return re.sub(r"^```.*?^```$", "", (ROOT / document).read_text(), flags=re.MULTILINE | re.DOTALL)


def mentions(document: str) -> list[str]:
    """What stands in backquotes."""
    return [" ".join(code.split()) for code in re.findall(r"`([^`]+)`", prose(document))]


def lines(block: str) -> list[str]:
    """The commands of a block; a file that `cat` makes of what follows is made here."""
    block = block.replace("\\\n", " ")
    for name, end, content in re.findall(r"^cat > (\S+) <<'(\w+)'\n(.*?)^\2$", block, re.MULTILINE | re.DOTALL):
        Path(name).write_text(content)
        block = block.replace(f"{content}{end}\n", "")
    return block.splitlines()


def words_of(line: str, comments: bool = True) -> list[str]:
    words = shlex.split(line, comments=comments)
    while words and re.match(r"\w+=", words[0]):
        del words[0]
    return words


def program_of(words: list[str]) -> tuple[str, list[str]] | None:
    """The program of ours that a command starts, and its arguments; None: another's program."""
    if words[0] in SCRIPTS:
        return words[0], words[1:]
    if "-m" in words and words[0] in ("python", "torchrun"):
        at = words.index("-m") + 1
        return (words[at], words[at + 1 :]) if words[at].split(".")[0] in PACKAGES else None
    if words[0] == "torchrun":
        at = words.index("$(which") + 1
        return words[at].rstrip(")"), words[at + 1 :]
    return None


def is_name(words: list[str]) -> bool:
    """Whether no more than a program is named, and at most an option of it."""
    return len(words) < 2 or (len(words) == 2 and words[1].startswith("--"))


def parse(program: str, arguments: list[str], shortened: bool, patch: pytest.MonkeyPatch) -> None:
    """Let a program of ours read its arguments, and do nothing more.

    Raises:
        SystemExit: it refuses them.
    """

    def read(*parts):
        understood(*parts)
        raise Parsed

    understood = envs.command.parse
    if shortened:
        arguments = [PLACEHOLDERS.get(word, word) for word in arguments if word != "..."]
        for option in SHORTENED.get(program, ()):
            arguments += [option, VALUES.get(option, "x")] if option not in arguments else []
    with patch.context() as context:
        context.setattr(envs.command, "parse", read)
        context.setattr(sys, "argv", [program, *arguments])
        with pytest.raises(Parsed):
            if program in SCRIPTS:
                module, function = SCRIPTS[program].split(":")
                getattr(importlib.import_module(module), function)()
            else:
                context.delitem(sys.modules, program, raising=False)  # else runpy warns
                runpy.run_module(program, run_name="__main__", alter_sys=True)


@pytest.fixture
def folder(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    for name in FILES:
        Path(name).parent.mkdir(parents=True, exist_ok=True)
        Path(name).write_text("{}")
    return tmp_path


def refused(document: str, patch: pytest.MonkeyPatch, capsys) -> list[str]:
    """The commands of a document that their programs do not understand, and why."""
    wrong, variables = [], {}
    blocks = [line for block in fences(document, "sh") for line in lines(block)]
    for line in blocks:
        variables |= re.findall(r'^([A-Z]+)="(.*)"$', line)
    for line, in_block in [(line, True) for line in blocks] + [(code, False) for code in mentions(document)]:
        for name, value in variables.items():
            line = line.replace(f"${name}", value)
        try:
            words = words_of(line, comments=in_block)
        except ValueError:  # a mention that is no command
            continue
        called = program_of(words) if words and (in_block or not is_name(words)) else None
        if called is None:
            wrong += [f"{line}: whose?"] if in_block and words and words[0] not in OTHERS else []
            continue
        program, arguments = called
        try:
            parse(program, arguments, not in_block or "..." in arguments, patch)
        except SystemExit as stop:
            wrong += [f"{line}: {capsys.readouterr().err.strip()}"] if stop.code else []
        except ImportError as error:
            wrong.append(f"{line}: {error}")
    return wrong


@pytest.mark.parametrize("document", DOCUMENTS)
def test_programs_understand_the_commands(document, folder, monkeypatch, capsys):
    assert refused(document, monkeypatch, capsys) == []


def test_what_is_misspelt_is_found(folder, monkeypatch, capsys):
    wrong = (
        "```sh\ncollect-rollout --out x\n```\n",
        "```sh\ncollect-rollouts --out x --sceen C\n```\n",
        "```sh\ncollect-rollouts --scene C\n```\n",  # without --out
        "Say `train-worldmodel --losses.knm 0` or `servo-eval --env planar-push`.\n",
        "Say `python -m planning.foresigt --checkpoint RUN`.\n",
    )
    for text in wrong:
        (folder / "x.md").write_text(text)
        assert len(refused(str(folder / "x.md"), monkeypatch, capsys)) == 1, text


@pytest.fixture(scope="module")
def options() -> set[str]:
    """All options of all programs."""
    known: set[str] = set()
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("COLUMNS", "200")
        for program in [*SCRIPTS, *MODULES]:
            told: list[str] = []
            patch.setattr(sys.stdout, "write", told.append)
            with pytest.raises(SystemExit):
                parse(program, ["--help"], False, patch)
            known |= set(re.findall(r"--[a-z][\w.-]*", "".join(told)))
    return known


@pytest.mark.parametrize("document", DOCUMENTS)
def test_options_that_are_mentioned_exist(document, options):
    spoken = [code.split() for code in mentions(document) if code.startswith(("--", *SCRIPTS))]
    named = {word.split("=")[0] for words in spoken for word in words if word.startswith("--")}
    assert named <= options | OTHERS_OPTIONS, named - options


def resolved(node: ast.expr, names: dict[str, object]) -> object:
    """What an expression of imported names and attributes is; None for all others."""
    if isinstance(node, ast.Name):
        return names.get(node.id)
    if isinstance(node, ast.Attribute):
        owner = resolved(node.value, names)
        return None if owner is None else getattr(owner, node.attr)
    return None


@pytest.mark.parametrize("document", DOCUMENTS)
def test_imports_attributes_and_arguments_of_python_exist(document):
    for block in fences(document, "python"):
        tree, names = ast.parse(block, document), {}
        for node in tree.body:
            if isinstance(node, ast.Import | ast.ImportFrom) and not ast.unparse(node).split()[1].startswith(
                NOT_INSTALLED
            ):
                exec(ast.unparse(node), names)
        for node in ast.walk(tree):
            if isinstance(node, ast.Attribute):
                resolved(node, names)
            called = resolved(node.func, names) if isinstance(node, ast.Call) else None
            if str(getattr(called, "__module__", None)).startswith(PACKAGES):
                given = {word.arg: None for word in node.keywords if word.arg}
                unpacked = any(word.arg is None for word in node.keywords)  # `**` may hold what is missing
                signature = inspect.signature(called)
                (signature.bind_partial if unpacked else signature.bind)(*node.args, **given)


@pytest.mark.parametrize("document", RUN)
def test_python_runs(document, folder):
    number, long, short = RUN[document]
    block = fences(document, "python")[number]
    assert long in block
    exec(compile(block.replace(long, short) if long else block, document, "exec"), {})


def test_a_robot_of_ones_own(folder):
    """Own data, a model that learns from them, and a controller that plans with it, as two documents tell it."""
    names: dict[str, object] = {}
    (recording,) = (block for block in fences("docs/data.md", "python") if "write_shard(" in block)
    exec(recording, names)
    train(parse_options(["--preset", "tiny", "--data", "data/mine", "--out", "runs/mine", "--steps", "2"]))
    (control,) = (block for block in fences("docs/planning.md", "python") if "class Tool" in block)
    exec(control.replace("range(30)", "range(4)"), names)
    assert isinstance(names["place"], np.ndarray) and np.abs(names["place"]).max() > 0  # it was moved


def anchors(document: Path) -> set[str]:
    """What headings are called in links."""
    headings = re.findall(r"^#+ (.+)$", re.sub(r"^```.*?^```$", "", document.read_text(), flags=re.M | re.S), re.M)
    return {re.sub(r"[^\w -]", "", heading.lower()).replace(" ", "-") for heading in headings}


@pytest.mark.parametrize("document", DOCUMENTS)
def test_links_lead_somewhere(document):
    for target in re.findall(r"\]\(([^)\s]+)\)", prose(document)):
        if not target.startswith(("http:", "https:")):
            name, _, heading = target.partition("#")
            there = (ROOT / document).parent / name if name else ROOT / document
            assert there.exists(), target
            assert not heading or heading in anchors(there), target


def test_targets_of_make_exist():
    targets = set(re.findall(r"^(\w+):", (ROOT / "Makefile").read_text(), re.MULTILINE))
    texts = [(ROOT / document).read_text() for document in DOCUMENTS]
    asked = {name for text in texts for name in re.findall(r"(?:`|^)make (\w+)", text, re.MULTILINE)}
    assert asked and asked <= targets


def test_the_model_document_names_every_module():
    table = (ROOT / "docs/model.md").read_text().split("\n## Files\n")[1].split("\n## ")[0]
    rows = [row.split("|")[1] for row in table.splitlines() if row.startswith("| `")]
    named = [name for row in rows for name in re.findall(r"`([^`]+)`", row)]
    package = ROOT / "worldmodel"
    modules = {path.name for path in package.glob("*.py")} - {"__init__.py"}
    held = [path.relative_to(package).parts for path in package.glob("*/**/*.*")]
    folders = {f"{parts[0]}/" for parts in held if "__pycache__" not in parts}
    assert sorted(named) == sorted(modules | folders)
