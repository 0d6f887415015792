"""Which reading of the paper's noise formula gives its decibels: all light levels and read noises, three lambdas.

    python benchmarks/noise_reading.py [--json FILE] [--distance 2]

The paper draws Y_n = G/F (Poisson(F/G Y) + N(0, s^2)), s = F 10^(-R/20), and states neither F, G and R nor the scale of
Y: what counts is how many electrons the brightest pixel has (of each frame: equal peak; of uniform light's: equal
frame, equal total), and s in electrons. It gives decibels of uniform light and of 49 dots at two distances of the mask:
21 to 23 and 34 to 35.5 at 2000 um, 16.9 to 19 and 30 to 30.5 at 750 um (figures 4 to 6). Neither does it say how lambda
is chosen: here the best of each image; the best that is one for all images of a family and distance; and one for
everything, as a constant in a program would be, relative to each model's largest sigma^2 or as it is.

Expected squared error of the Tikhonov image in closed form, bias plus variance, noise taken for white with the mean
variance of all frames; means over eight test images in the idealised model. Printed is, for each convention, lambda and
brightness of the images, the reading that is nearest to all four bands, and how far outside of them it is [dB]; with
``--distance`` to the two bands of that distance alone.
"""

from __future__ import annotations

import itertools
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from harness import arguments, show, write
from solver import dots

from mitsim.devices.camera import CameraGeometry, centred_edges
from mitsim.reconstruct.solver import Prepared, prepare
from mitsim.report import CONVENTIONS, EQUAL_PEAK, EQUAL_TOTAL
from mitsim.studies.framework.experiment import SIDE, TEST_IMAGES, picture
from tests.shadow_factor import scene_factor

N, WIDTH_MM = 128, 120.0
BANDS = {(2.0, 1): (21.0, 23.0), (2.0, 7): (34.0, 35.5), (0.75, 1): (16.9, 19.0), (0.75, 7): (30.0, 30.5)}
"""Decibels of the paper, by distance of the mask [mm] and dots a side."""
ELECTRONS = np.logspace(1.5, 7, 45)
READ_NOISE = np.logspace(-1, 3, 33)
LAMBDAS = np.logspace(-12, 1, 105)
"""Of the largest sigma^2, an eighth of a decade apart."""
RULES = ("best of each image", "one a family and distance", "one relative lambda", "one lambda")
BRIGHTNESS = ("0.05 to 0.9", "0 to 1")


@dataclass(frozen=True)
class Case:
    """One family at one distance: squared bias (images, lambdas), gain of white noise (lambdas), peak and mean of the
    frames of each image, and of uniform light's peak there, per unit of reflectance."""

    bias: np.ndarray
    gain: np.ndarray
    peak: np.ndarray
    mean: np.ndarray
    scale: float


def factor_at(distance: float) -> np.ndarray:
    """Phi (512, 128) of the paper's camera with its mask at ``distance`` [mm]."""
    camera = CameraGeometry.build("the paper's camera", mask_distance=distance)
    mask, scene = camera.build_mask(), centred_edges(N, WIDTH_MM / N)
    profile = mask.terms[0][1]
    return scene_factor(profile, mask.feature_mm, camera.pixel_edges, scene, distance, camera.scene_distance)


def images(brightness: str) -> np.ndarray:
    """(8, n, n) reflectances."""
    block = SIDE // N
    found = np.stack([picture(name) / 255 for name in TEST_IMAGES]).reshape(-1, N, block, N, block).mean(axis=(2, 4))
    if brightness == BRIGHTNESS[0]:
        return found
    low, high = found.min(axis=(1, 2), keepdims=True), found.max(axis=(1, 2), keepdims=True)
    return (found - low) / (high - low)


def case(factor: np.ndarray, k: int, shown: np.ndarray) -> Case:
    """Of ``k`` x ``k`` dots, 1 for uniform light."""
    patterns = dots(N, k)
    prepared: Prepared = prepare(factor, factor, patterns, patterns)
    sigma = np.outer(prepared.left.singular, prepared.right.singular)
    scale = float(np.square(sigma).max())
    kept = [np.square(sigma) / (np.square(sigma) + scale * lam) for lam in LAMBDAS]
    coefficients = [prepared.coefficients(image) for image in shown]
    bias = np.array([[np.square((1 - part) * own).sum() for part in kept] for own in coefficients]) / N**2
    gain = np.array([np.square(part / sigma).sum() for part in kept]) / N**2
    frames = [
        [factor[:, i::k] @ image[i::k, j::k] @ factor[:, j::k].T for i in range(k) for j in range(k)] for image in shown
    ]
    peak = np.array([max(frame.max() for frame in own) for own in frames])
    return Case(bias, gain, peak, np.array([np.mean(own) for own in frames]), scale)


def errors(one: Case, uniform: Case, k: int, convention: str, electrons: float) -> Iterator[np.ndarray]:
    """Squared error (images, lambdas) for each read noise."""
    peak = one.peak if convention == EQUAL_PEAK else uniform.peak
    gain = electrons / peak / (k * k if convention == EQUAL_TOTAL else 1)
    for read in READ_NOISE:
        variance = one.mean / gain + np.square(read / gain)
        yield one.bias + variance[:, None] * one.gain


def decibels(squared: np.ndarray, rule: str) -> np.ndarray:
    """Mean PSNR over images: one number, or one for each lambda where one is to serve everything."""
    psnr = -10 * np.log10(squared)
    if rule == RULES[0]:
        return psnr.max(axis=1).mean(keepdims=True)
    return psnr.mean(axis=0).max(keepdims=True) if rule == RULES[1] else psnr.mean(axis=0)


def outside(found: dict[tuple[float, int], np.ndarray]) -> np.ndarray:
    """Largest distance of four figures from their bands [dB]."""
    return np.max(
        [np.maximum(0, np.maximum(BANDS[key][0] - psnr, psnr - BANDS[key][1])) for key, psnr in found.items()], axis=0
    )


def aligned(psnr: np.ndarray, one: Case, first: Case) -> np.ndarray:
    """``psnr`` by relative lambda as it is at the same lambda: that of the ``first`` case's scale."""
    return np.interp(np.log(LAMBDAS * first.scale / one.scale), np.log(LAMBDAS), psnr)


def nearest(cases: dict[tuple[float, int], Case], convention: str, rule: str) -> dict[str, object]:
    """The reading that is nearest to all bands."""
    best: dict[str, object] = {"outside_db": np.inf}
    first = next(iter(cases.values()))
    for electrons in ELECTRONS:
        by_case = {
            key: list(errors(one, cases[key[0], 1], key[1], convention, electrons)) for key, one in cases.items()
        }
        for index, read in enumerate(READ_NOISE):
            found = {key: decibels(squared[index], rule) for key, squared in by_case.items()}
            if rule == RULES[3]:
                found = {key: aligned(psnr, cases[key], first) for key, psnr in found.items()}
            distance = outside(found)
            at = int(distance.argmin())
            if distance[at] < best["outside_db"]:  # type: ignore[operator]
                shown = {f"{key[0]:g} mm, {key[1] ** 2} dots": round(float(psnr[at]), 1) for key, psnr in found.items()}
                best = {"outside_db": float(distance[at]), "electrons": float(electrons), "read_noise_e": float(read)}
                best |= {"dynamic_range_db": float(20 * np.log10(electrons / read)), "psnr_db": shown}
                if len(distance) > 1:
                    best["lambda_relative"] = float(LAMBDAS[at])
    return best


def main() -> None:
    parser = arguments(__doc__)
    parser.add_argument("--distance", type=float, choices=[2.0, 0.75], help="of the mask [mm]; both if not given")
    options = parser.parse_args()
    bands = [key for key in BANDS if options.distance in (None, key[0])]
    factors, rows = {distance: factor_at(distance) for distance, _ in bands}, []
    for brightness in BRIGHTNESS:
        shown = images(brightness)
        cases = {(distance, k): case(factors[distance], k, shown) for distance, k in bands}
        for convention, rule in itertools.product(CONVENTIONS, RULES):
            found = nearest(cases, convention, rule)
            rows.append({"images": brightness, "convention": convention, "lambda": rule, **found})
            show(f"{brightness}, {convention}, {rule}", found)
    write(options.json, rows)


if __name__ == "__main__":
    main()
