"""How docs read: pages in Markdown in, words a sentence and a paragraph out.

    python -m tests.prose [PAGE ...]

prints a line a page. Counted is prose: no code, formulas on lines of their own, tables, headings or pictures. A span of
code, a formula in a line and a link's target are one word each, or none.
"""

from __future__ import annotations

import re
import sys
from dataclasses import dataclass
from pathlib import Path
from statistics import median

_NO_PROSE = (
    r"^<!--.*?-->$",
    r"^```.*?^```$",
    r"^\$\$.*?^\$\$$",
)
"""Blocks that are not read as sentences."""
_BREAK = re.compile(r"(?<=[.!?])[)*\"]*\s+(?=[^\sa-z])|(?<=[.!?]\*\*)\s+")
"""Where one sentence ends and the next begins."""


@dataclass(frozen=True)
class Style:
    """Words of each sentence and of each paragraph of a page."""

    sentences: list[int]
    paragraphs: list[int]
    longest: str
    """The first words of the longest paragraph."""

    @property
    def median(self) -> float:
        return float(median(self.sentences))


def paragraphs(text: str) -> list[str]:
    """Prose of a page, a paragraph or an item of a list each."""
    for pattern in _NO_PROSE:
        text = re.sub(pattern, "\n", text, flags=re.M | re.S)
    text = re.sub(r"^(?: {4}|\||#|!\[).*$", "\n", text, flags=re.M)
    text = re.sub(r"^\s*(?:[-*]|\d+\.) ", "\n\n", text, flags=re.M)
    return [" ".join(part.split()) for part in re.split(r"\n\s*\n", text) if re.search(r"\w", part)]


def words(sentence: str) -> int:
    """Words of a sentence; a span of code and a formula are one each."""
    sentence = re.sub(r"`[^`]*`|\$[^$]*\$", " x ", sentence)
    sentence = re.sub(r"\]\([^)]*\)", "", sentence)
    return len(re.findall(r"[\w.%'/-]*\w[\w.%'/-]*", sentence))


def style(text: str) -> Style:
    """How a page reads."""
    found = paragraphs(text)
    lengths = [words(paragraph) for paragraph in found]
    sentences = [count for paragraph in found for part in _BREAK.split(_plain(paragraph)) if (count := words(part))]
    return Style(sentences, lengths, found[lengths.index(max(lengths))][:60])


def _plain(paragraph: str) -> str:
    """A paragraph whose code and formulas have no full stops, and a label such as **Why.** none either."""
    paragraph = re.sub(r"`[^`]*`|\$[^$]*\$", "X", paragraph)
    return re.sub(r"\*\*([^*]*)\*\*", lambda label: label[1].rstrip("."), paragraph)


def main() -> None:
    root = Path(__file__).resolve().parents[1]
    for name in sys.argv[1:] or ["README.md", *(path.relative_to(root).as_posix() for path in root.glob("docs/*.md"))]:
        page = style((root / name).read_text(encoding="utf-8"))
        sys.stdout.write(
            f"{name}: {sum(page.paragraphs)} words; a sentence {page.median:g} in the median, "
            f"{max(page.sentences)} at most; a paragraph {max(page.paragraphs)} at most: {page.longest}\n"
        )


if __name__ == "__main__":
    main()
