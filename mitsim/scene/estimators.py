"""What an estimator cannot render: the tree of a checked scene in; its refusal out, or what is known to be lost.

The factored estimator knows surfaces alone. The reference is the scene's own integrator, and of Mitsuba's only those
for volumes see a light through what lets it straight on: the others take a hole that is cut out for opaque whenever
they connect a surface to a lamp or projector, and lose that light without a word.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import chain
from typing import TYPE_CHECKING

import mitsuba as mi

from mitsim.core.errors import MitsimError
from mitsim.scene.limits import PLUGINS, references

if TYPE_CHECKING:
    from mitsim.scene.outline import Outline

STRAIGHT = ("circular", "mask", "null", "polarizer", "retarder", "thindielectric")
"""Materials that let light straight on."""
_BUMPS = ("bumpmap", "normalmap")
"""Materials that turn another's frame, and do not tell which light it lets straight on."""
_MIRRORS = ("conductor", "dielectric", "mitsim_glass", "plastic", "thindielectric")
"""Materials that reflect or bend light into single directions."""
SMALL_LAMPS = ("directional", "point", "spot")
"""Lamps that no path runs into."""
_VOLUMETRIC = ("volpath", "volpathmis")


@dataclass(frozen=True)
class Unfit:
    """Why an estimator must not be given a scene, and which light it loses of one that it may be given; None: none.

    Attributes
    ----------
    factored, reference
        the refusal of each estimator.
    caustics
        what the reference loses: light that mirrors or glass bring to surfaces from what no path runs into.
    lamps, instances
        what the factored estimator loses: the same of lamps, and light over mirrors or glass inside of instances.
    """

    factored: MitsimError | None = None
    reference: MitsimError | None = None
    caustics: str | None = None
    lamps: str | None = None
    instances: str | None = None

    @classmethod
    def of(cls, outline: Outline, nodes: Sequence[mi.parser.SceneNode]) -> Unfit:
        """What is known from the ``nodes`` of a scene, the root first, whose tags the ``outline`` has."""
        tree = _References(nodes)
        medium = next(tree.to(PLUGINS["medium"].split()), None)
        if medium is None:
            factored = _blended_picture(outline, tree)
        else:
            node, name = medium
            rule = (
                "only the reference estimator follows light through media; remove it, or use render's reference with "
                "the integrator volpath"
            )
            factored = outline.tag(node).refusal(name, "a medium", rule)
        opaque = _under_bumps(outline, tree)
        return cls(
            factored or opaque,
            _lost_by_integrator(outline, tree, medium or next(tree.to(STRAIGHT), None)) or opaque,
            _caustics(outline, tree, ("projector", *SMALL_LAMPS), "the reference"),
            _caustics(outline, tree, SMALL_LAMPS, "the factored estimator"),
            _in_instances(outline, tree),
        )


def _caustics(outline: Outline, tree: _References, lights: Sequence[str], estimator: str) -> str | None:
    """What an ``estimator`` loses where one of the ``lights`` shines on a mirror."""
    mirror = next(tree.to(_MIRRORS), None)
    light = next((node for node in tree.nodes if node.props.plugin_name() in lights), None)
    if mirror is None or light is None:
        return None
    place, what = outline.tag(mirror[0]), tree.plugin(*mirror)
    rule = (
        f"{estimator} finds no light of it that {place.path.name}:{place.line} ({what}) brings to other surfaces, so "
        "that is missing; use a light that has a surface (area; mitsim_projector for the reference)"
    )
    return str(outline.tag(light).refusal("light", repr(str(light.props.plugin_name())), rule))


def _blended_picture(outline: Outline, tree: _References) -> MitsimError | None:
    """The refusal of a projector whose picture blends its texels: the factored estimator takes pixels for even."""
    for node in tree.nodes:
        picture = tree.child(node, "irradiance") if node.props.plugin_name() == "projector" else None
        if picture is None or picture.props.plugin_name() != "bitmap":
            continue
        kind = picture.props.get("filter_type", "bilinear")  # Mitsuba's default
        if kind != "nearest":
            rule = (
                "the projector's pixels would run into each other, where patterns need them even; give its bitmap "
                '<string name="filter_type" value="nearest"/>, and blur_pixels of the projector\'s TOML file for a blur'
            )
            return outline.tag(picture, "filter_type").refusal("filter_type", repr(kind), rule)
    return None


def _in_instances(outline: Outline, tree: _References) -> str | None:
    for node in tree.nodes:
        if node.props.plugin_name() != "shapegroup":
            continue
        mirror = next(tree.below(node, _MIRRORS), None)
        if mirror is not None:
            rule = (
                "inside of an instance glass is no pane and a mirror casts no glint: light that it brings from the "
                "projector is missing; place the shape itself"
            )
            return str(outline.tag(mirror).refusal("bsdf", repr(str(mirror.props.plugin_name())), rule))
    return None


def _under_bumps(outline: Outline, tree: _References) -> MitsimError | None:
    """The refusal of a hole or pane inside a material that hides from connections what passes it."""
    for node, name in tree.to(_BUMPS):
        bumps = tree.nodes[node.props[name].index()]
        hidden = next(tree.below(bumps, STRAIGHT), None)
        if hidden is not None:
            what = str(hidden.props.plugin_name())
            rule = (
                f"inside of a {bumps.props.plugin_name()} Mitsuba takes it for opaque wherever it connects a surface "
                "to a light, so that is missing; turn them round: the mask, or other material that light passes, "
                "outermost"
            )
            return outline.tag(hidden).refusal("bsdf", repr(what), rule)
    return None


def _lost_by_integrator(
    outline: Outline, tree: _References, cause: tuple[mi.parser.SceneNode, str] | None
) -> MitsimError | None:
    """The refusal of an integrator that has no paths from the camera, or that loses light at the ``cause``, a node and
    the name of its property."""
    found = (node for node in tree.nodes if node.props.plugin_name() in PLUGINS["integrator"].split())
    integrator = next(found, None)
    plugin = integrator.props.plugin_name() if integrator is not None else "path"  # Mitsuba's own default
    if integrator is not None and plugin == "ptracer":
        rule = "it starts paths at lamps alone, and mitsim_lensless needs those of the camera; use path or volpath"
        return outline.tag(integrator).refusal("integrator", repr(plugin), rule)
    if cause is None or plugin in _VOLUMETRIC:
        return None
    place, what = outline.tag(cause[0]), tree.plugin(*cause)
    rule = f"it loses light at {place.path.name}:{place.line} ({what}); use volpath"
    return outline.tag(integrator or tree.nodes[0]).refusal("integrator", repr(plugin), rule)


@dataclass(frozen=True)
class _References:
    """The tree's nodes, and what they refer to."""

    nodes: Sequence[mi.parser.SceneNode]

    def to(self, plugins: Sequence[str]) -> Iterator[tuple[mi.parser.SceneNode, str]]:
        """Nodes, and names of their properties, that refer to one of the ``plugins``.

        Neither the scene nor a material that no shape has: they only list.
        """
        materials = PLUGINS["bsdf"].split()
        users = [node for node in self.nodes[1:] if node.props.plugin_name() not in materials]
        used = (other for node in users for other in self.below(node, materials))
        for node in chain(users, used):
            for name in node.props.keys():  # noqa: SIM118 - Properties is no dict
                if self.plugin(node, name) in plugins:
                    yield node, name

    def below(self, node: mi.parser.SceneNode, plugins: Sequence[str]) -> Iterator[mi.parser.SceneNode]:
        """Nodes of one of the ``plugins`` that a ``node`` refers to, itself or by others."""
        for other in (self.nodes[index] for index in references(node.props)):
            if other.props.plugin_name() in plugins:
                yield other
            yield from self.below(other, plugins)

    def child(self, node: mi.parser.SceneNode, name: str) -> mi.parser.SceneNode | None:
        """What the property refers to; None unless there is one, and an object."""
        if name not in node.props or node.props.type(name) != mi.Properties.Type.ResolvedReference:
            return None
        return self.nodes[node.props[name].index()]

    def plugin(self, node: mi.parser.SceneNode, name: str) -> str:
        """The plugin that the property refers to; nothing unless it is an object."""
        child = self.child(node, name)
        return "" if child is None else str(child.props.plugin_name())
