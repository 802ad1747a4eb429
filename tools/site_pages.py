"""Pages of the documentation that are made while it is built, as hooks of MkDocs (`mkdocs.yml`).

The start page is the README. The command's reference is what its verbs say to `--help`, that of
Python lists what `sart_toolkit/__init__.pyi` offers, and troubleshooting is what the classes in
`sart_toolkit/errors.py` say of themselves, each with the messages that are raised with it.

Equations between dollar signs become MathML, which browsers draw by themselves. A page that would
ask another server for something ends the build.
"""

from __future__ import annotations

import ast
import collections
import contextlib
import html
import io
import os
import re
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any
from unittest import mock

from sart_toolkit.cli.verbs import VERBS

ROOT = Path(__file__).parents[1]
PACKAGE = ROOT / "sart_toolkit"

# --- pages --------------------------------------------------------------------------------------


def generated_pages() -> dict[str, str]:
    """Markdown of every page that no file in `docs/` holds, by its path there."""
    return {
        "index.md": start_page(),
        "reference/command.md": command_page(),
        **python_pages(),
        "troubleshooting.md": troubleshooting_page(),
    }


def start_page() -> str:
    """The README, its links as seen from `docs/`."""
    return (ROOT / "README.md").read_text().replace("](docs/", "](")


def command_page() -> str:
    """Each verb of `sart`: what it does, examples, and its flags in a table."""
    parts = [
        "# The command",
        "`sart VERB --help` says the same. Every verb ends with exit status 0, or with 2 and one "
        "line that says what is wrong ([troubleshooting](../troubleshooting.md)).",
    ]
    for name, verb in VERBS.items():
        # Boxes are drawn only in UTF-8, and so wide that every flag has one line.
        printed = io.TextIOWrapper(io.BytesIO(), "utf-8")
        with (
            mock.patch.dict(os.environ, {"COLUMNS": "2000"}),
            contextlib.redirect_stdout(printed),
            contextlib.suppress(SystemExit),
        ):
            verb.parse(name, ["--help"])
        printed.seek(0)
        parts += [f"## sart {name}", *help_as_markdown(printed.read())]
    return "\n\n".join(parts) + "\n"


def help_as_markdown(text: str) -> Iterable[str]:
    """The paragraphs of what a verb says to `--help`: what it does, examples, a table of flags."""
    head, *boxes = text.split("╭─")
    usage, *paragraphs = head.strip().split("\n\n")
    examples = [p.removeprefix("Example: ") for p in paragraphs if p.startswith("Example: ")]
    yield from (plain(p) for p in paragraphs if not p.startswith("Example: "))
    yield "\n".join(["```", usage.removeprefix("usage: "), *examples, "```"])
    # What a long flag does stands in the line below it.
    pattern = r"^│ (\S.*?)(?: {2,}| *│\n│ {3,})(\S.*?) *│$"
    flags = [found for box in boxes for found in re.findall(pattern, box, re.M)]
    rows = [f"| `{flag}` | {plain(said)} |" for flag, said in flags if flag != "-h, --help"]
    if not rows:
        raise ValueError(f"no flags in what {usage!r} says to --help")
    yield "\n".join(["| flag | what it does |", "| --- | --- |", *rows])


def plain(text: str) -> str:
    """Text of a program as Markdown: nothing but what is between backquotes has a meaning."""
    parts = re.split(r"(`[^`]*`)", text)
    for i in range(0, len(parts), 2):
        parts[i] = re.sub(r"[\\*_\[\]<>|$&`]", lambda match: f"&#{ord(match[0])};", parts[i])
    return "".join(parts)


def public_names() -> dict[str, list[str]]:
    """The names that `import sart_toolkit` offers, in full, by the package they come from."""
    names = collections.defaultdict(list)
    for node in ast.parse((PACKAGE / "__init__.pyi").read_text()).body:
        if isinstance(node, ast.ImportFrom) and node.module:
            package = node.module.partition(".")[0]
            names[package] += [f"sart_toolkit.{node.module}.{name.name}" for name in node.names]
    return dict(names)


def python_pages() -> dict[str, str]:
    """A page for the public names of each package, and one that lists them."""
    listed = ["# Python", "What `import sart_toolkit as sart` offers, imported when first used."]
    pages = {}
    for package, names in public_names().items():
        file = PACKAGE / package / "__init__.py"
        file = file if file.exists() else PACKAGE / f"{package}.py"
        about = (ast.get_docstring(ast.parse(file.read_text())) or "").partition("\n\n")[0]
        entries = [
            f"::: {name}\n    options:\n      heading: sart.{name.rpartition('.')[2]}"
            for name in names
        ]
        pages[f"reference/python/{package}.md"] = "\n\n".join([f"# {package}", about, *entries, ""])
        links = ", ".join(f"[`{n.rpartition('.')[2]}`]({package}.md#{n})" for n in names)
        listed.append(f"**[{package}]({package}.md)**: {links}")
    pages["reference/python/index.md"] = "\n\n".join(listed) + "\n"
    return pages


def troubleshooting_page() -> str:
    """Each class of errors: when it is raised, what to do, and the messages it comes with."""
    parts = [
        "# Troubleshooting",
        "What the toolkit refuses is a `SartError`: a line that says what is wrong, what it got "
        "and what to do. `sart doctor` says what of it works on this machine. Below are all the "
        "errors by their classes, with their messages to be searched for; … stands for a value.",
    ]
    messages = raised_messages()
    for node in ast.parse((PACKAGE / "errors.py").read_text()).body:
        if not isinstance(node, ast.ClassDef):
            continue
        parts += [f"## {node.name}", ast.get_docstring(node) or ""]
        if found := messages.get(node.name):
            lines = "\n".join(f"    - {plain(message)}" for message in found)
            parts.append(f'??? note "{len(found)} messages"\n\n{lines}')
    return "\n\n".join(parts) + "\n"


def raised_messages() -> dict[str, list[str]]:
    """The messages in the toolkit's `raise` statements by class, in order, values replaced by …"""
    found: Mapping[str, set[str]] = collections.defaultdict(set)
    for file in PACKAGE.rglob("*.py"):
        for node in ast.walk(ast.parse(file.read_text())):
            match node:
                case ast.Raise(exc=ast.Call(func=ast.Name(id=name), args=[first, *_])):
                    message = _text(first)
                    if re.search(r"\w{3}", message):
                        found[name].add(message)
    return {
        name: sorted(texts, key=lambda text: text.strip("…: ").lower())
        for name, texts in found.items()
    }


def _text(node: ast.expr) -> str:
    match node:
        case ast.Constant(value=str(text)):
            return text
        case ast.JoinedStr(values=values):
            return "".join(_text(value) for value in values)
        case ast.BinOp(op=ast.Add(), left=left, right=right):
            return _text(left) + _text(right)
    return "…"


# --- hooks --------------------------------------------------------------------------------------


def on_config(config: Any) -> Any:
    """Below the list of Python's names comes a page for each package."""

    def completed(entry: Any) -> Any:
        if entry == "reference/python/index.md":
            pages = [f"reference/python/{package}.md" for package in public_names()]
            return {"Python": [entry, *pages]}
        if isinstance(entry, dict):
            return {title: completed(inner) for title, inner in entry.items()}
        return [completed(inner) for inner in entry] if isinstance(entry, list) else entry

    config.nav = completed(config.nav)
    return config


def on_files(files: Any, config: Any) -> Any:
    """The generated pages beside those of `docs/`."""
    from mkdocs.structure.files import File

    for path, text in generated_pages().items():
        files.append(File.generated(config, path, content=text))
    return files


def on_page_content(text: str, **_: Any) -> str:
    """Equations as MathML."""
    from latex2mathml.converter import convert

    def drawn(match: re.Match[str]) -> str:
        display = "block" if match["block"] else "inline"
        equation = convert(html.unescape(match["block"] or match["inline"]), display=display)
        return f'<div class="equation">{equation}</div>' if match["block"] else equation

    inner = r"(?:\\\[(?P<block>.*?)\\\]|\\\((?P<inline>.*?)\\\))"
    return re.sub(rf'<(span|div) class="arithmatex">{inner}</\1>', drawn, text, flags=re.S)


def on_post_page(output: str, page: Any, **_: Any) -> str:
    """The page, if it asks no other server for anything.

    Raises:
        mkdocs.exceptions.PluginError: it would.
    """
    from mkdocs.exceptions import PluginError

    if asked := requests_of(output):
        raise PluginError(f"{page.file.src_uri}: would ask other servers for {asked}")
    return output


def requests_of(page: str) -> list[str]:
    """The addresses on other servers that a browser asks for when it shows the page."""
    tags = re.findall(r"<(?:script|link|img|iframe|video|audio|source|object)\b[^>]*>", page)
    found = (re.search(r'(?:src|href|srcset|data)="((?:https?:)?//[^"]+)"', tag) for tag in tags)
    return [match[1] for match in found if match]
