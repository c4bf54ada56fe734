"""What the documents refer to exists: links, files, modules, commands and their options.

The documents and the texts in the source (docstrings, comments, messages, help) are in short sentences and standard
terms.
"""

import ast
import re
import runpy
import shlex
import subprocess
import tokenize
from collections.abc import Iterator
from functools import cache
from pathlib import Path
from unittest import mock

import pytest
import typer
import yaml

from active6d_tools.cli import app

ROOT = Path(__file__).parents[2]
PAGES = [
    *(ROOT / name for name in ("README.md", "CONTRIBUTING.md", "CHANGELOG.md", "tests/README.md", "bags/README.md")),
    *(ROOT / name for name in ("examples/README.md", "src/active6d_core/active6d_core/objects/README.md")),
    *sorted((ROOT / "docs").glob("*.md")),
]
LONGEST_SENTENCE = 40
# Words of a private dialect, which standard terms replace.
DIALECT = re.compile(
    r"\b(told|mends?|mended|anew|by itself|by themselves|of its own accord|latched|whoever|somebody|everybody"
    r"|hears?|heard|speaks?|luck|gauge)\b",
    re.IGNORECASE,
)
#: Files that the commands of a page make, or that a user brings along.
MADE = re.compile(
    r"^(bags/|scenes?[._]|mug|mine|my_|part\.|path/|\.venv|~|/|steps\.png|curves\.|state\.|best\.|report\.html|build/|rgb/|depth/)"
)


def pages(test):
    """Run a test on every page."""
    return pytest.mark.parametrize("page", PAGES, ids=[str(page.relative_to(ROOT)) for page in PAGES])(test)


@cache
def files() -> frozenset[str]:
    """Every file of the repository, from its root."""
    listed = [
        path.relative_to(ROOT)
        for top in ("src", "tests", "docs", "docker", "scripts")
        for path in (ROOT / top).rglob("*")
        if path.is_file()
    ]
    return frozenset(str(path) for path in [*listed, *(path.relative_to(ROOT) for path in ROOT.glob("*"))])


def anchors(page: Path) -> set[str]:
    """The anchors that GitHub gives to a page's headings."""
    headings = re.findall(r"^#+ (.+)$", page.read_text(), re.MULTILINE)
    return {re.sub(r"[^\w\- ]", "", heading.lower()).replace(" ", "-") for heading in headings}


def spans(page: Path) -> list[str]:
    """What stands in backticks, outside of blocks."""
    return re.findall(r"`([^`\n]+)`", re.sub(r"^```.*?^```", "", page.read_text(), flags=re.DOTALL | re.MULTILINE))


def commands(page: Path) -> list[list[str]]:
    """The words of every command that a page shows: in blocks, indented lines and backticks; comments left out."""
    text = page.read_text().replace("\\\n", " ")
    blocks = re.findall(r"^```\w*\n(.*?)^```", text, re.DOTALL | re.MULTILINE)
    lines = [line for block in blocks for line in block.splitlines()]
    lines += re.findall(r"^ {4}(\w.*)$", text, re.MULTILINE) + re.findall(r"`([^`\n]+)`", text)
    found = []
    for line in lines:
        line = re.sub(r"\s#\s.*$", "", line.strip())
        if re.match(r"(\w+=\S+ )*(active6d|python -m|make|ros2 run|ros2 launch) ", line):
            words = shlex.split(line)
            while "=" in words[0]:
                words.pop(0)
            found.append(words)
    return found


def prose(page: Path) -> list[str]:
    """A page's sentences, those in cells of tables too; code and what is generated are left out."""
    text = page.read_text()
    text = re.sub(r"<!-- (tables of|results:).*?<!-- end -->", "\n", text, flags=re.DOTALL)
    text = re.sub(r"^```.*?^```", "\n", text, flags=re.DOTALL | re.MULTILINE)
    text = re.sub(r"^ {4}\S.*$", "\n", text, flags=re.MULTILINE)
    text = re.sub(r"^#.*$", "\n", text, flags=re.MULTILINE)
    text = re.sub(r"\]\([^)]*\)", "]", text)
    text = re.sub(r"`[^`\n]*`", "CODE", text)
    text = re.sub(r"^\|.*$", lambda row: "\n\n".join(row[0].split("|")) + "\n", text, flags=re.MULTILINE)
    paragraphs = re.split(r"\n\s*\n|\n\s*(?:[-*]|\d+\.) ", text)
    joined = [" ".join(paragraph.split()) for paragraph in paragraphs]
    return [sentence for paragraph in joined for sentence in re.split(r"(?<=[.!?])\s+(?=[A-Z0-9\"(*\[])", paragraph)]


@pages
def test_links_resolve(page):
    for target in re.findall(r"\]\(([^)\s]+)\)", page.read_text()):
        if "://" in target:
            continue
        path, _, anchor = target.partition("#")
        linked = (page.parent / path).resolve() if path else page
        assert linked.exists(), target
        assert not anchor or anchor in anchors(linked), target


@pages
def test_files_exist(page):
    for span in spans(page):
        if re.fullmatch(r"[\w./-]+\.(py|md|yaml|json|sh|cff|toml|txt|rviz)", span) and not MADE.match(span):
            assert any(file == span or file.endswith(f"/{span}") for file in files()), span


@pages
def test_modules_and_their_names_exist(page):
    for dotted in re.findall(
        r"\bactive6d_\w+(?:\.\w+)+", re.sub(r"\S+\.(py|md|sh)\b|\w+\.launch", "", page.read_text())
    ):
        package, *parts = dotted.split(".")
        folder = ROOT / "src" / package / package
        while parts and (folder / parts[0]).is_dir():
            folder /= parts.pop(0)
        module = folder / f"{parts.pop(0)}.py" if parts and (folder / f"{parts[0]}.py").is_file() else folder
        if parts:
            source = (module if module.is_file() else module / "__init__.py").read_text()
            assert re.search(rf"\b(def|class) {parts[0]}\b|^{parts[0]}\b", source, re.MULTILINE), dotted


@pages
def test_commands_exist(page):
    for words in commands(page):
        if words[0] == "active6d":
            check_active6d(words)
        elif words[0] == "make":
            targets = re.findall(r"^(\w+):", (ROOT / "Makefile").read_text(), re.MULTILINE)
            assert {word for word in words[1:] if "=" not in word} <= set(targets), words
        elif words[0] == "python":
            module = words[2].replace(".", "/")
            known = {"pytest", "pip", "active6d_tools"}
            assert words[2] in known or any(file.endswith(f"/{module}.py") for file in files()), words
        elif words[1] == "run":
            assert words[3] in executables(words[2]), words
        else:
            launch = next(ROOT.glob(f"src/{words[2]}/launch/{words[3]}")).read_text()
            for argument in (word.partition(":=")[0] for word in words[4:] if ":=" in word):
                assert f'"{argument}"' in launch, words


def check_active6d(words: list[str]) -> None:
    """Every word up to the first argument names a command, and every option is one of the last of these."""
    command, rest = typer.main.get_command(app), words[1:]
    while hasattr(command, "commands") and rest and not rest[0].startswith("-"):
        names = rest.pop(0)
        for name in names.split("|"):
            assert name in command.commands, words
        command = command.commands[names.split("|")[0]]
    known = {option for parameter in command.params for option in [*parameter.opts, *parameter.secondary_opts]}
    assert {word.partition("=")[0] for word in rest if word.startswith("--")} <= known | {"--help"}, words


@cache
def executables(package: str) -> set[str]:
    """The commands that a package's setup.py declares."""
    with mock.patch("setuptools.setup") as setup:
        runpy.run_path(str(ROOT / "src" / package / "setup.py"))
    return {script.partition("=")[0].strip() for script in setup.call_args.kwargs["entry_points"]["console_scripts"]}


@pages
def test_sentences_are_short(page):
    long = [sentence for sentence in prose(page) if len(sentence.split()) > LONGEST_SENTENCE]
    assert not long, "\n".join(long)


@pages
def test_words_are_standard(page):
    odd = [sentence for sentence in prose(page) if DIALECT.search(sentence)]
    assert not odd, "\n".join(odd)


def source_texts(path: Path) -> Iterator[str]:
    """Strings and comments of a Python file, values in formatted strings as CODE; neighbouring comments are joined."""
    tree = ast.parse(path.read_text())
    parts = {id(part) for node in ast.walk(tree) if isinstance(node, ast.JoinedStr) for part in node.values}
    for node in ast.walk(tree):
        if isinstance(node, ast.JoinedStr):
            yield "".join(part.value if isinstance(part, ast.Constant) else "CODE" for part in node.values)
        elif isinstance(node, ast.Constant) and isinstance(node.value, str) and id(node) not in parts:
            yield node.value
    with path.open("rb") as file:
        comments = [token for token in tokenize.tokenize(file.readline) if token.type == tokenize.COMMENT]
    block: list[str] = []
    for before, token in zip([None, *comments], comments, strict=False):
        alone = token.line.lstrip().startswith("#")
        if not alone or before is None or before.start[0] != token.start[0] - 1:
            yield " ".join(block)
            block = []
        block.append(token.string.lstrip("#: "))
    yield " ".join(block)


def source_sentences() -> Iterator[tuple[Path, str]]:
    """The sentences in all Python files of the packages; attributes, arguments and items of lists are their own."""
    for path in sorted((ROOT / "src").rglob("*.py")):
        for text in source_texts(path):
            plain = re.sub(r"``[^`]*``|`[^`]*`", "CODE", text)
            for paragraph in re.split(r"\n\s*\n|\n\s*(?:[-*]|\d+\.) |\n\s*\w+(?: \([^)]*\))?: ", plain):
                for sentence in re.split(r"(?<=[.!?])\s+(?=[A-Z0-9\"(*\[])", " ".join(paragraph.split())):
                    yield path, sentence


def test_sentences_in_the_source_are_short():
    long = [f"{path.name}: {text}" for path, text in source_sentences() if len(text.split()) > LONGEST_SENTENCE]
    assert not long, "\n".join(long)


def test_words_in_the_source_are_standard():
    odd = [f"{path.name}: {text}" for path, text in source_sentences() if " " in text and DIALECT.search(text)]
    assert not odd, "\n".join(odd)


def test_no_page_is_left_out():
    tracked = subprocess.run(["git", "ls-files", "*.md"], cwd=ROOT, capture_output=True, text=True, check=False)
    if tracked.returncode:
        pytest.skip("not a git checkout")
    assert {ROOT / name for name in tracked.stdout.split()} <= set(PAGES)


def test_the_citation_names_the_version_and_the_paper():
    citation = yaml.safe_load((ROOT / "CITATION.cff").read_text())
    versions = {re.search(r'version="(.+?)"', setup.read_text())[1] for setup in ROOT.glob("src/*/setup.py")}
    assert {citation["version"]} == versions
    assert {"cff-version", "message", "title", "authors"} <= citation.keys()
    paper = citation["preferred-citation"]
    assert paper["title"] in " ".join((ROOT / "README.md").read_text().split())
    assert [author["family-names"] for author in paper["authors"]] == ["Sock", "Garcia-Hernando", "Kim"]
