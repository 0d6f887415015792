"""The site that `make docs` builds: pages in Markdown, the API from docstrings, notebooks as they are stored.

The repository's root is the source folder, so that links lead to the same places here as on disk. Nothing is fetched
and no notebook is run: a test does that. Formulas become MathML, which browsers show by themselves.
"""

import ast
import base64
import inspect
import json
import re
import struct
from pathlib import Path

from docutils import nodes
from latex2mathml.converter import convert
from sphinx.application import Sphinx
from sphinx.writers.html5 import HTML5Translator

import mitsim

ROOT = Path(__file__).resolve().parents[1]
PICTURES = "docs/_build/notebooks"
TUTORIALS = "shifting_dots", "own_camera_and_picture", "calibration", "noise", "diffraction", "ambient_light", "gloss"
TUTORIALS += "interreflection", "depth", "mask_design", "real_captures", "networks"
"""Notebooks in the order to learn by."""

project = "mitsim"
author = "the mitsim authors"
copyright = f"2026, {author}"
version = release = mitsim.__version__

extensions = ["myst_nb", "sphinx.ext.autodoc", "numpydoc"]
root_doc = "docs/index"
include_patterns = ["README.md", "CHANGELOG.md", "CONTRIBUTING.md", "docs/**"]
exclude_patterns = [".*", "mitsim", "tests", "scenes", "docs/_build", "docs/conf.py", "docs/images", "**/.*"]

nb_execution_mode = "off"
myst_enable_extensions = ["dollarmath", "substitution"]
myst_heading_anchors = 4
myst_fence_as_directive = ["math"]

autodoc_member_order = "bysource"
autodoc_typehints = "none"
numpydoc_show_class_members = False

html_math_renderer = "mathml"
html_theme = "furo"
html_title = f"mitsim {version}"
html_static_path = ["site.css", "math.woff2"]
html_css_files = ["site.css"]

CONTENTS = """
```{toctree}
:hidden:
:caption: Start

Five minutes </README>
tour
notebooks/index
gallery
```

```{toctree}
:hidden:
:caption: How-to

howto
sessions
bench
exchange
studies
learned
```

```{toctree}
:hidden:
:caption: Background

scope
physics
effects
masks
colour
sensor
calibration
rare_light
reconstruction
convolutional
error_budget
validation
```

```{toctree}
:hidden:
:caption: Reference

formats
scene_files
device_files
folders
json_keys
real_camera
api
glossary
/CHANGELOG
migrating
```

```{toctree}
:hidden:
:caption: Developers

architecture
extending
decisions
robustness
growth
/CONTRIBUTING
```
"""


def face() -> str:
    """Markdown that documents every name of `mitsim.__all__`: functions, and classes with their public members, those
    of our own base classes among them."""
    blocks = []
    for name in sorted(getattr(mitsim, "__all__", ()), key=lambda name: (name[0].isupper(), name)):
        kind = "autoclass" if inspect.isclass(getattr(mitsim, name)) else "autofunction"
        members = "   :members:\n   :inherited-members: Exception, BaseModel\n" if kind == "autoclass" else ""
        blocks.append(f"```{{eval-rst}}\n.. {kind}:: mitsim.{name}\n{members}```")
    return "\n\n".join(blocks)


def notebooks() -> str:
    """Markdown that shows of every notebook the picture that fits a tile best, with its title."""
    tiles = []
    for number, name in enumerate(TUTORIALS, 1):
        cells = json.loads((ROOT / f"docs/notebooks/{name}.ipynb").read_text(encoding="utf-8"))["cells"]
        title = cells[0]["source"][0].lstrip("# ").strip()
        outputs = [output.get("data", {}) for cell in cells for output in cell.get("outputs", ())]
        pictures = [base64.b64decode("".join(data["image/png"])) for data in outputs if "image/png" in data]
        picture = ROOT / PICTURES / f"{name}.png"
        picture.parent.mkdir(parents=True, exist_ok=True)
        picture.write_bytes(min(pictures, key=misfit))
        tiles.append(f"<div>\n\n![{title}](/{PICTURES}/{name}.png)\n\n[{number}. {title}]({name}.ipynb)\n\n</div>")
    contents = "```{toctree}\n:hidden:\n\n" + "\n".join(TUTORIALS) + "\n```"
    return "\n".join(["", '<div class="tiles figures">', *tiles, "</div>", "", contents])


def misfit(png: bytes) -> float:
    """Return how far a picture's width over height is from a tile's, as a ratio."""
    width, height = struct.unpack(">2I", png[16:24])
    return max(3 * width / (4 * height), 4 * height / (3 * width))


def plugins() -> str:
    """Markdown that shows the manuals of mitsim's own Mitsuba plugins as they stand in their modules."""
    names = "lensless", "materials", "measured", "lens", "ies"
    sources = [ROOT / "mitsim/transport/plugins" / f"{name}.py" for name in names]
    manuals = [ast.get_docstring(ast.parse(path.read_text(encoding="utf-8"))) for path in sources]
    return "\n\n".join(f"```text\n{manual}\n```" for manual in manuals)


myst_substitutions = {"face": face(), "plugins": plugins()}


def add_contents(_: Sphinx, page: str, source: list[str]) -> None:
    """Add the list of pages, and the tiles of tutorials, which the site alone has."""
    if page == root_doc:
        source[0] += CONTENTS
    if page == "docs/notebooks/index":
        source[0] += notebooks()


PRIME = r'<mo class="prime" lspace="0" rspace="0">\2</mo>'
BAR = r'<mo stretchy="false" lspace="0" rspace="0">\1</mo>'


def add_formula(writer: HTML5Translator, node: nodes.math | nodes.math_block) -> None:
    """A formula as MathML: no script is needed to show it."""
    alone = isinstance(node, nodes.math_block)
    formula = convert(node.astext(), display="block" if alone else "inline")
    # A prime is raised by its font; as a superscript it would be raised and made smaller twice.
    letter, prime = r"(<m[io]>[^<]*</m[io]>)", r"<mi>(&#x0203[2-4];)</mi>"
    formula = re.sub(rf"<msup>{letter}{prime}</msup>", rf"<mrow>\1{PRIME}</mrow>", formula)
    formula = re.sub(
        rf"<msup>{letter}<mrow>{prime}(.*?)</mrow></msup>",
        rf"<msup><mrow>\1{PRIME}</mrow><mrow>\3</mrow></msup>",
        formula,
    )
    formula = re.sub(prime, r'<mi class="prime">\1</mi>', formula)
    # Bars of a norm do not know their partner, so that each would stretch to the height of the formula.
    formula = re.sub(r"<mo(?: stretchy=\"false\")?>(&#x02016;|&#x0007C;)</mo>", BAR, formula)
    writer.body.append(f'<div class="formula">{formula}</div>' if alone else formula)
    raise nodes.SkipNode


def add_front(app: Sphinx, _: Exception | None) -> None:
    """Write an index.html that leads to the first page, and mark the gallery's options, so that none is broken."""
    gallery = Path(app.outdir, "docs/gallery.html")
    if gallery.exists():
        marked = re.sub(r"(?<= )--[\w-]+", r'<span class="option">\g<0></span>', gallery.read_text(encoding="utf-8"))
        gallery.write_text(marked, encoding="utf-8")
    page = f'<!doctype html><meta charset="utf-8"><meta http-equiv="refresh" content="0; url={root_doc}.html">'
    Path(app.outdir, "index.html").write_text(page, encoding="utf-8")


def setup(app: Sphinx) -> None:
    app.add_html_math_renderer("mathml", (add_formula, None), (add_formula, None))
    app.connect("source-read", add_contents)
    app.connect("build-finished", add_front)
