"""README's tour of the command line: its commands in, the figures that they print and those that README states out.

``python -m tests.tour`` runs the commands in a new folder and writes their outputs into README, and the PSNR where it
is stated again. Seconds and memory stay as they are there: they are an idle machine's. ``docs/images/make.py`` draws
the picture that has it in its title.
"""

from __future__ import annotations

import math
import re
import shlex
import subprocess
import sys
import tempfile
import textwrap
from collections.abc import Iterator
from pathlib import Path

README = Path(__file__).resolve().parents[1] / "README.md"
BENCH = README.parent / "docs" / "bench.md"
VERBS = ("capture", "calibrate", "reconstruct")
"""Of photograph: from a scene to an image, with every figure at its default."""
_BLOCK = r"^    \$ mitsim ({verb} .*)\n((?:    (?!\$ ).*\n)*)"
_MACHINE = re.compile(r"\bin [\d.]+ s\b(?: \(transport [^)]*\))?|\bmemory [\d.]+ GiB of at most [\d.]+ predicted")
"""What an output says of the machine, not of the scene."""
_NUMBER = re.compile(r"(?<![\w.])\d+(?:\.\d+)?(?:e[+-]?\d+)?")
_WIDTH = 116
"""Columns of README's outputs, without their indent."""


def stated(verb: str) -> tuple[str, str]:
    """The command line of a ``verb`` in README, and the output under it."""
    found = re.search(_BLOCK.format(verb=verb), README.read_text(encoding="utf-8"), flags=re.M)
    assert found, f"README has no command of {verb}"
    return found[1], found[2]


def outputs(folder: Path) -> Iterator[tuple[str, str]]:
    """Each verb of the tour, and what its command prints in ``folder``."""
    for verb in VERBS:
        command = [sys.executable, "-m", "mitsim", *shlex.split(stated(verb)[0]), "--quiet"]
        done = subprocess.run(command, cwd=folder, capture_output=True, text=True, check=False)
        assert done.returncode == 0, f"{shlex.join(command)}: {done.returncode}\n{done.stderr}"
        yield verb, done.stdout


def differences(readme: str, now: str) -> list[str]:
    """Figures of an output ``now`` that differ from ``readme``'s by more than one of the last digit printed, or the
    sentences, where those differ."""
    texts = [" ".join(_MACHINE.sub("", " ".join(text.split())).split()) for text in (readme, now)]
    sentences = [_NUMBER.sub("#", text) for text in texts]
    if sentences[0] != sentences[1]:
        return [f"{sentences[0]}\n{sentences[1]}"]
    pairs = zip(*(_NUMBER.findall(text) for text in texts), strict=True)
    return [f"{old} -> {new}" for old, new in pairs if abs(float(old) - float(new)) > 1.001 * _last_digit(old)]


def _last_digit(number: str) -> float:
    """What one of the last printed digit is worth; a whole number's is 1."""
    mantissa, _, exponent = number.partition("e")
    return math.pow(10, int(exponent or 0) - len(mantissa.partition(".")[2]))


def updated(page: str, verb: str, now: str) -> str:
    """The ``page`` with the output ``now`` of a ``verb``."""
    command, old = stated(verb)
    kept = iter(_MACHINE.findall(" ".join(old.split())))
    text = "\n".join(_MACHINE.sub(lambda found: next(kept, found[0]), line) for line in now.splitlines())
    lines = [wrapped for line in text.splitlines() for wrapped in textwrap.wrap(line, _WIDTH)]
    return page.replace(
        f"    $ mitsim {command}\n{old}", f"    $ mitsim {command}\n" + "".join(f"    {line}\n" for line in lines)
    )


def main() -> None:
    with tempfile.TemporaryDirectory() as folder:
        for verb, now in outputs(Path(folder)):
            for difference in differences(stated(verb)[1], now):
                print(f"{verb}: {difference}")
            README.write_text(updated(README.read_text(encoding="utf-8"), verb, now), encoding="utf-8")
    (psnr,) = re.findall(r"PSNR ([\d.]+) dB", stated("reconstruct")[1])
    for page, words in ((README, f"# {psnr}, as above"), (BENCH, f"calibrates itself it is {float(psnr):.1f} dB")):
        pattern = re.sub(r"\d+\\\.\d+", r"[\\d.]+", re.escape(words))
        page.write_text(re.sub(pattern, words, page.read_text(encoding="utf-8")), encoding="utf-8")


if __name__ == "__main__":
    main()
