"""Where the reference's time and noise go: one scene, one integrator, cameras that differ by one cause each.

    python benchmarks/reference_speed.py [--json FILE] [--scene photograph --scene cookie_bag] [--spp 16] [--repeat 5]

All cameras share scene, projector, integrator and film, have the field of the lensless one, and are rendered in turn
in one process on one thread, warm; seconds are the least of the processor's over ``--repeat`` rounds. Ratios hold
within a run; the machine's load moves all of them. Each camera and what it has beyond the one before:

=============  =====================================================================================================
perspective    Mitsuba's own: a pixel's rays are neighbours
python         the same rays by a plugin in Python
origins        they start all over the sensor
directions     instead, each ray of a pixel has a direction of its own, drawn from the whole field stop: no two
               neighbours meet the same texel, material or light
bare           both: a sensor without a mask
window         the mask's transmission as a factor of what is drawn evenly from the field stop
reference      ``mitsim_lensless``: open places of the mask alone are drawn
stratified     the same from Owen-scrambled Sobol points, as `mitsim render` draws them
=============  =====================================================================================================

``variance`` is that of one pass, summed over the pixels, over the frame's energy; its product with the seconds is what
counts, since it tells the time for a wanted error. Only the last three cameras estimate the same. ``--wavefront``
renders the reference with other numbers of paths in flight.

Measured (2 cores shared with other work, two runs a scene; seconds over the perspective camera's): Python takes nothing
(0.98 to 1.08), origins 0 to 0.4, directions 0.4 to 0.6 in the photograph and 0.9 to 1.4 in the cookie bag, mask and
openings 0 to 0.3: in all 1.6 to 1.7 and 1.9 to 2.5. So nearly all of it is directions that differ between neighbours. A
sensor without a lens has them by its nature: a pixel sees the whole field, and pixels that shared directions would
share errors, which the tests between the estimators take for independent. Wavefronts of 2^18 to 2^24 paths differ by
40 %, the smallest is fastest. Variance times seconds fell from 0.485 to 0.032 in the photograph (16 paths a pass), from
1.83 to 0.23 in the cookie bag (4 paths).
"""

from __future__ import annotations

import argparse
import json
import os
import platform
import statistics
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

import mitsim as ms
from mitsim.core.environment import versions

CAMERAS = ("perspective", "python", "origins", "directions", "bare", "window", "reference", "stratified")
SAME = ("window", "reference", "stratified")
"""Cameras of one expected frame."""


def film(pixels: int) -> dict[str, object]:
    """A fresh film like that of the shipped scenes."""
    of_one = {"pixel_format": "luminance", "component_format": "float32", "rfilter": {"type": "box"}}
    return {"type": "hdrfilm", "width": pixels, "height": pixels, **of_one}


def cameras(bench: ms.Bench) -> dict[str, Any]:
    """All cameras by name, at the place of the bench's own."""
    import drjit as dr
    import mitsuba as mi

    geometry = bench.geometry

    class Rays(mi.Sensor):  # type: ignore[misc]
        """``kind`` of rays, as the module says."""

        def __init__(self, props: mi.Properties) -> None:
            super().__init__(props)
            self.m_needs_sample_3 = True
            self.kind = props["kind"]
            ((_, rows, _),) = geometry.build_mask().terms if self.kind == "window" else ((1, np.ones(1), 0),)
            self.bits = mi.Float(rows.astype(np.float32))

        def sample_ray(
            self, time: mi.Float, sample1: mi.Float, sample2: mi.Point2f, sample3: mi.Point2f, active: mi.Bool = True
        ) -> tuple[mi.Ray3f, mi.Spectrum]:
            waves, weight = self.sample_wavelengths(dr.zeros(mi.SurfaceInteraction3f), sample1, active)
            turned = self.kind in ("directions", "bare", "window")
            t = (1 - 2 * (sample3 if turned else sample2)) * geometry.tan_half_fov
            u = mi.Point2f(0)
            if self.kind in ("origins", "bare", "window"):
                u = (1 - 2 * (sample2 if turned else sample3)) * geometry.half_width
            squared = 1 + dr.squared_norm(t)
            weight *= (2 * geometry.tan_half_fov) ** 2 / dr.square(squared)
            if self.kind == "window":
                for start, slope in ((u.x, t.x), (u.y, t.y)):
                    feature = -(start + geometry.mask_distance * slope) / geometry.mask_feature
                    weight *= dr.gather(mi.Float, self.bits, mi.UInt32(feature + 0.5 * dr.width(self.bits)), active)
            to_world = self.world_transform()
            direction = to_world @ (mi.Vector3f(t.x, t.y, 1) * dr.rsqrt(squared))
            return mi.Ray3f(to_world @ mi.Point3f(u.x, u.y, 0), direction, time, waves), weight

        def sample_ray_differential(self, *samples: object) -> tuple[mi.RayDifferential3f, mi.Spectrum]:
            ray, weight = self.sample_ray(*samples)
            return mi.RayDifferential3f(ray), weight

        def bbox(self) -> mi.ScalarBoundingBox3f:
            return mi.ScalarBoundingBox3f()

    mi.register_sensor("benchmark_rays", lambda props: Rays(props))
    numbers = geometry.model_dump(exclude={"pixels"}, exclude_none=True)
    place = {"to_world": mi.ScalarTransform4f(np.array(bench.loaded.camera.world_transform().matrix)[..., 0])}

    def made(kind: str) -> object:
        common = {**place, "film": film(geometry.pixels)}
        common["sampler"] = {"type": "independent"}
        if kind == "perspective":
            return mi.load_dict({"type": "perspective", "fov": geometry.fov, **common})
        if kind in ("reference", "stratified"):
            return mi.load_dict({"type": "mitsim_lensless", **numbers, **common})
        return mi.load_dict({"type": "benchmark_rays", "kind": kind, **common})

    return {kind: made(kind) for kind in CAMERAS}


def rendered(bench: ms.Bench, camera: Any, spp: int, seed: int) -> tuple[float, np.ndarray]:
    """Processor seconds of one pass, and its frame."""
    import mitsuba as mi

    started = time.process_time()
    image = np.array(mi.render(bench.loaded.scene, sensor=camera, spp=spp, seed=seed), dtype=np.float64)
    return time.process_time() - started, image[..., 0]


def measured(bench: ms.Bench, spp: int, repeat: int) -> dict[str, dict[str, float]]:
    """Each camera's seconds a pass, paths a second, variance and their product."""
    made = cameras(bench)
    passes: dict[str, list[tuple[float, np.ndarray]]] = {kind: [] for kind in CAMERAS}
    for seed in range(repeat + 1):
        for kind, camera in made.items():
            if kind == "stratified":
                camera.stratify((1000 + seed, spp))
            passes[kind].append(rendered(bench, camera, spp, seed))
    result = {}
    for kind, (_, *warm) in passes.items():
        seconds, frames = min(each for each, _ in warm), np.stack([frame for _, frame in warm])
        noise = float(frames.var(axis=0, ddof=1).sum())
        variance = noise / (float(np.square(frames.mean(axis=0)).sum()) - noise / repeat)
        row = {"seconds": seconds, "spread": statistics.median(each for each, _ in warm) / seconds}
        row["million_paths_a_second"] = frames[0].size * spp / seconds / 1e6
        if kind in SAME:
            row |= {"variance": variance, "variance_x_seconds": variance * seconds}
            row["mean"], row["mean_error"] = float(frames.mean()), (noise / repeat) ** 0.5 / frames[0].size
        result[kind] = row
    for row in result.values():
        row["seconds_over_perspective"] = row["seconds"] / result["perspective"]["seconds"]
    return result


def wavefronts(bench: ms.Bench, repeat: int, spps: tuple[int, ...] = (1, 4, 16, 64)) -> dict[str, float]:
    """Million paths a second of the reference by its paths in flight."""
    camera, size = bench.loaded.camera, bench.geometry.pixels**2
    measure: Callable[[int, int], float] = lambda spp, seed: rendered(bench, camera, spp, seed)[0]  # noqa: E731
    return {
        str(size * spp): size * spp / min([measure(spp, seed) for seed in range(repeat + 1)][1:]) / 1e6 for spp in spps
    }


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--json", type=Path)
    parser.add_argument("--scene", action="append", default=[])
    parser.add_argument("--spp", type=int, default=16)
    parser.add_argument("--repeat", type=int, default=5)
    parser.add_argument("--wavefront", action="store_true")
    options = parser.parse_args()
    result: dict[str, object] = {"spp": options.spp, "repeat": options.repeat, "seed": 0, "threads": 1}
    result |= {"machine": f"{platform.processor() or platform.machine()}, {os.cpu_count()} cores"}
    result |= {"versions": versions(), "scenes": {}, "wavefronts": {}}
    for name in options.scene or ["photograph", "cookie_bag"]:
        bench = ms.open_bench(name, for_render=True)
        import drjit as dr

        dr.set_thread_count(1)  # once the scene's files have been read
        result["scenes"][name] = measured(bench, options.spp, options.repeat)
        if options.wavefront:
            result["wavefronts"][name] = wavefronts(bench, options.repeat)
        dr.set_thread_count(2)
    text = json.dumps(result, indent=1)
    print(text)
    if options.json:
        options.json.write_text(text + "\n")


if __name__ == "__main__":
    main()
