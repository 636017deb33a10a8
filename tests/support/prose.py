"""Check prose and names of the repository, or of paths: `python tests/support/prose.py PATH...`.

Prose is the text of Markdown files, docstrings and comments; code in backticks is left out. Every
finding is one line, `file:line: found; use ...`. Names are those of Python code. The exit code is
1 if there is any finding.
"""

import ast
import io
import re
import subprocess
import sys
import tokenize
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

ROOT = Path(__file__).parents[2]

# Words and phrases that readers have to translate, as regular expressions, and better ones.
WORDS = {
    r"what is left\b": "residual, rest",
    r"so many\b": "a number",
    r"by its lack\b": "without it",
    r"as (?:it|they) should\b": "correctly",
    r"anew\b": "again",
    r"once more\b": "again",
    r"one and the same\b": "the same",
    r"no such thing\b": "none",
    r"spoil(?:s|t|ed)?\b": "corrupt",
    r"untouched\b": "without contact, undeformed",
    r"dear(?:er|est)\b": "costlier",
    r"(?:is|are|was|were) told\b": "is reported",
    r"held against\b": "compared with",
    r"in hand\b": "current",
    r"without a word\b": "silently",
    r"by whoever\b": "by anyone",
    r"that which\b": "rewrite the sentence",
}
# Names in code that readers have to translate, and better ones. A word counts only as a whole name.
NAMES = {
    "share": "fraction",
    "together": "batch_size, batched",
    "untouched": "no_contact, undeformed, reference",
    "carried": "multiplier, transferred",
    "between": "name the quantity",
    "Verdict": "Outcome",
    "verb": "command",
    "verbs": "commands, cli",
    "facts": "metadata, properties",
    "said": "printed",
    "spoilt": "corrupt",
    "ballast": "reserved",
    "newtons": "force, errors",
    "Look": "CollectionView",
    "Walk": "PlanRunner",
    "Sentinels": "Interlocks",
    "Judgement": "Result",
    "Claim": "Criterion",
    "Stencil": "BlockMatrix",
    "Offer": "Candidate",
    "Course": "TrainState",
    "Life": "DeviceVariation",
    "REST": "name the state",
}
# "What" in a thousand words, at most; the model projects have 0.05 to 0.3.
WHAT_MOST = 1.0
# Words of a sentence, at most.
SENTENCE_MOST = 40
# Pages generated from the code.
LEFT_OUT = tuple(
    f"docs/reference/{name}.md" for name in ("commands", "public-names", "wrong-inputs")
)

_WORDS = {re.compile(rf"\b{word}", re.IGNORECASE): instead for word, instead in WORDS.items()}
_OPENERS = re.compile(r"\s*(What|Whether|How)\b")
# Code, tags of templates, comments, addresses and the names of arguments, which are no prose.
_CODE = re.compile(
    r"```.*?```|`[^`]*`|\{\{.*?\}\}|\{%.*?%\}|<!--.*?-->|https?://\S+|\]\([^)]*\)|^ {4,}\w+(?=: )",
    re.DOTALL | re.MULTILINE,
)
_WORD = re.compile(r"[A-Za-z][A-Za-z'-]*")
# Words of one letter are mostly symbols of formulae.
_LONG_WORD = re.compile(r"[A-Za-z][A-Za-z'-]+")
# Ends of sentences, of paragraphs, items and cells, and gaps between columns.
_ENDS = re.compile(r"(?<=[.!?:;])\s+|\n\s*\n|\n\s*[-*|#>]|\n\s*\d+\.\s|\||(?<=\S) {2,}")


class Text(NamedTuple):
    """A piece of prose, its code masked by a word, and where it begins."""

    line: int
    text: str
    docstring: bool


def texts_of(path: Path) -> Iterator[Text]:
    """Yield the pieces of prose in a file, by its kind."""
    content = path.read_text(encoding="utf-8")
    if path.suffix == ".md":
        yield Text(1, _masked(content), docstring=False)
        return
    for node in ast.walk(ast.parse(content)):
        body = getattr(node, "body", None)
        for statement in body if isinstance(body, list) else ():
            if (
                isinstance(statement, ast.Expr)
                and isinstance(statement.value, ast.Constant)
                and isinstance(statement.value.value, str)
            ):
                yield Text(statement.lineno, _masked(statement.value.value), docstring=True)
    block: list[str] = []
    begin = last = 0
    for token in tokenize.generate_tokens(io.StringIO(content).readline):
        if token.type != tokenize.COMMENT:
            continue
        if block and token.start[0] != last + 1:
            yield Text(begin, _masked("\n".join(block)), docstring=False)
            block = []
        begin = begin if block else token.start[0]
        block.append(token.string.lstrip("# "))
        last = token.start[0]
    if block:
        yield Text(begin, _masked("\n".join(block)), docstring=False)


def _masked(text: str) -> str:
    """Return the text with each piece of code replaced by the word `code`, lines kept."""
    return _CODE.sub(lambda code: "code" + "\n" * code[0].count("\n"), text)


def findings_of(text: Text) -> Iterator[str]:
    """Yield `line: found; use ...` for each finding in a piece of prose."""
    if text.docstring and (opener := _OPENERS.match(text.text)):
        yield f"{text.line}: docstring begins with {opener[1]}; begin with a verb or a noun"
    for pattern, instead in _WORDS.items():
        for found in pattern.finditer(text.text):
            line = text.line + text.text.count("\n", 0, found.start())
            yield f"{line}: {found[0]!r}; use {instead}"
    for sentence in _ENDS.split(text.text):
        if (count := len(_LONG_WORD.findall(sentence))) > SENTENCE_MOST:
            line = text.line + text.text.count("\n", 0, text.text.find(sentence))
            yield f"{line}: a sentence of {count} words; at most {SENTENCE_MOST}"


def names_of(path: Path) -> Iterator[str]:
    """Yield `line: name; use ...` for each name of `NAMES` in a Python file."""
    content = path.read_text(encoding="utf-8")
    for token in tokenize.generate_tokens(io.StringIO(content).readline):
        if token.type == tokenize.NAME and token.string in NAMES:
            yield f"{token.start[0]}: name {token.string}; use {NAMES[token.string]}"


def files(paths: list[str]) -> list[Path]:
    """Return the Python and Markdown files among those that Git knows under `paths`."""
    listed = subprocess.run(
        ["git", "ls-files", "--", *(paths or ["."])],
        cwd=ROOT,
        capture_output=True,
        text=True,
        check=True,
    ).stdout.splitlines()
    return [
        ROOT / name
        for name in listed
        if name.endswith((".py", ".md"))
        and not name.startswith(LEFT_OUT)
        and Path(name) != Path(__file__).relative_to(ROOT)
        and (ROOT / name).exists()
    ]


def main(paths: list[str]) -> int:
    """Print all findings and return the exit code."""
    words = whats = count = 0
    for path in files(paths):
        for finding in names_of(path) if path.suffix == ".py" else ():
            print(f"{path.relative_to(ROOT)}:{finding}")
            count += 1
        for text in texts_of(path):
            for finding in findings_of(text):
                print(f"{path.relative_to(ROOT)}:{finding}")
                count += 1
            found = [word.lower() for word in _WORD.findall(text.text)]
            words += len(found)
            whats += found.count("what")
    rate = 1000 * whats / max(words, 1)
    print(f'prose: {words} words, {rate:.2f} times "what" in 1,000, {count} findings')
    return int(count > 0 or rate > WHAT_MOST)


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
