"""Peers on our frontier: Mitsuba's ``volpath`` with our medium, and ``tpt``, in scenes that both can render.

Cubes of absorbing grains in white light are measured as `tsdf-frontier` does, and so are Mitsuba's pictures of them,
against the same truth: error against processor time of all threads. Each peer's picture is the mean of sixteen, whose
spread is its noise. Roulette is off in ``volpath``, which changes little here.
Writes DIR/peers.md and peers.png: each point of a peer beside the least error of our candidates after the same time.

    python benchmarks/bench_peers.py --out bench
"""

import argparse
import math
import threading
import time
from dataclasses import replace
from pathlib import Path
from typing import Any

import mitsuba as mi
import numpy as np

import tsdf.loaders.mitsuba as loader
from tsdf.data import format as tsdf_format
from tsdf.data import library
from tsdf.files import replacing
from tsdf.picture.render import Picture
from tsdf.picture.world import build
from tsdf.scene.scene import Box, Camera, ConstantLight, GrainSpec, MediumSpec, Scene
from tsdf.scene.specs import Absorption
from tsdf.study import frontier, frontier_plots, plots
from tsdf.study.candidates import Candidate, candidates, taken
from tsdf.study.frontier import Frontier, Measured, Way
from tsdf.study.ranking import mean_of

SIDE = 32  # pixels
PARTS = 16  # pictures of a peer in a run
CASES = (
    ("glass-beads", 0.5, 6.0, 0.1),
    ("salt", 0.3, 12.0, 0.05),
)  # table, packing fraction, half side, absorption [R]
PEERS = {"volpath": "volume", "tpt": "teleport"}  # and our level of the same model
COLOURS = {"volpath": "#e69f00", "tpt": "#d55e00"}


class Peer(Way):
    """Another renderer, on its way as a candidate."""

    name: str
    scene: Any

    def sized(self, seconds: float) -> None:
        """Choose how many samples a picture has; compiles."""
        self.samples, took = 1, 0.0
        self._shot(1, 0)
        while took < 0.2 * seconds / PARTS:
            self.samples *= 2
            took = self._shot(self.samples, 0)[1]
        self.samples = max(1, int(self.samples * seconds / PARTS / took))
        self._shot(self.samples, 0)  # compiles once more where the number is another

    def add(self, run: int, truth: Picture) -> None:
        """Add a run: sixteen pictures, and the error of 1, 2, 4, 8 and all of them."""
        shots = [self._shot(self.samples, 1 + run * PARTS + k) for k in range(PARTS)]
        pictures, spent = np.array([picture for picture, _ in shots]), np.cumsum([took for _, took in shots])
        whole = replace(truth, rgb=pictures.mean(axis=0), variance=pictures.var(axis=0, ddof=1) / PARTS, trust=None)
        whole = replace(whole, samples=np.full(truth.samples.shape, PARTS * self.samples), truncated=0, faults=0)
        self.runs.append(replace(whole, processor_seconds=float(spent[-1])))
        grown = []
        for count in (1, 2, 4, 8, 16):
            own = replace(truth, rgb=pictures[:count].mean(axis=0))
            grown.append((float(spent[count - 1]), frontier.square(own, truth, False, 1.0)))
        self.grown.append(grown)

    def _shot(self, spp: int, seed: int) -> tuple[np.ndarray, float]:
        begin = time.process_time()
        picture = np.array(mi.render(self.scene, spp=spp, seed=seed), float)[..., :3]
        return picture, time.process_time() - begin


def ours(name: str, fraction: float, half: float, absorption: float) -> Scene:
    camera = Camera((0.5 * half, -5.0 * half, 1.2 * half), (0.0, 0.0, 0.0), SIDE, SIDE, fov_deg=25.0)
    grain = GrainSpec(library.FOLDER / f"{name}{library.SUFFIX}", absorption=Absorption("grey", (absorption,)))
    medium = MediumSpec(Box((-half,) * 3, (half,) * 3), fraction, 1.0, (grain,), inside="centres")
    return Scene(camera, (ConstantLight((1.0, 1.0, 1.0)),), (medium,), name=name)


def theirs(peer: str, name: str, fraction: float, half: float, absorption: float) -> Any:
    table = tsdf_format.read(library.FOLDER / f"{name}{library.SUFFIX}")
    grains = {"packing_fraction": fraction, "grain_radius": 1.0, "absorption": absorption}
    interior = loader.medium(table, **grains) if peer == "volpath" else loader.granular(table, **grains)
    integrator = {"type": "tpt"} if peer == "tpt" else {"type": "volpath", "max_depth": -1, "rr_depth": 1_000_000}
    look = mi.ScalarTransform4f().look_at([0.5 * half, -5.0 * half, 1.2 * half], [0.0, 0.0, 0.0], [0.0, 0.0, 1.0])
    film = {"type": "hdrfilm", "width": SIDE, "height": SIDE, "rfilter": {"type": "box"}, "pixel_format": "rgb"}
    cube = {"type": "cube", "to_world": mi.ScalarTransform4f().scale(half), "bsdf": {"type": "null"}}
    return mi.load_dict(
        {
            "type": "scene",
            "integrator": integrator,
            "sensor": {"type": "perspective", "fov": 25.0, "to_world": look, "film": film},
            "light": {"type": "constant"},
            "cube": cube | {"interior": interior},
        }
    )


def measure(case: tuple[str, float, float, float], seconds: float, runs: int) -> tuple[Frontier, dict[str, Measured]]:
    """Return our frontier and the peers' numbers."""
    scene, notes = ours(*case), list[str]()
    truth = frontier._truth(scene, notes)
    ways = frontier._possible(scene, candidates(grains=(0, 3)), truth, notes, lambda *_: None, threading.Event())
    peers = []
    for name, level in PEERS.items():
        peer = Peer(Candidate(level), build(taken(scene, Candidate(level)), level), 0)
        peer.name, peer.scene = name, theirs(name, *case)
        peers.append(peer)
    share = seconds / runs / (len(ways) + len(peers) + 4)
    for way in (truth, *ways):
        way.samples = frontier._affordable(way.world, share * (4 if way is truth else 1), 0, None, threading.Event())
    for peer in peers:
        peer.sized(share)
    packings = frontier._Packings(scene)
    for run in range(runs):
        for way in (truth, *ways):
            own = None if way is truth else truth.runs[run]
            way.take(packings.of(way.world, run), run, own, 0, None, threading.Event())
        for peer in peers:
            peer.add(run, truth.runs[run])
        print(f"{scene.name}: run {run + 1} of {runs}", flush=True)
    scale = float(np.mean([picture.rgb.mean() for picture in truth.runs]))
    whole = {"whole": np.ones((SIDE, SIDE), bool)}
    found = frontier._summed(scene, truth, ways, runs, runs, 0, notes)
    return found, {peer.name: frontier._measured(peer, truth.runs, whole, scale) for peer in peers}


def table(found: Frontier, peers: dict[str, Measured]) -> list[str]:
    """Return a line for each point of a peer: its error, our least after the same time, and the level that has it."""
    lines = []
    for name, peer in peers.items():
        same = next(row for row in found.rows if row.candidate == peer.candidate)
        slower = mean_of(peer.noise_seconds).value / mean_of(same.noise_seconds).value
        bias = mean_of(np.array(peer.bias["whole"]) - same.bias["whole"])
        print(f"{found.scene}: {name} takes {slower:.1f} times as long to the noise of our {same.candidate}; "
              f"bias to it {100.0 * bias.value:+.2f} +- {100.0 * bias.error:.2f} %")  # fmt: skip
        for spent, squares in peer.curve:
            value, error = mean_of(squares)
            least = found.squared_errors(spent).mean(axis=1)
            first = int(least.argmin())
            lines.append(
                f"| {found.scene} | {name} | {spent:.3g} | {100.0 * math.sqrt(max(value, 0.0)):.3g} "
                f"| {50.0 * error / math.sqrt(max(value, 1e-30)):.1g} | {100.0 * math.sqrt(least[first]):.3g} "
                f"| {found.rows[first].candidate} | {math.sqrt(max(value, 0.0) / least[first]):.2g} "
                f"| {slower:.1f} |"
            )
    return lines


def chart(results: list[tuple[Frontier, dict[str, Measured]]]) -> Any:
    """Return our lines with the peers' points and lines over them."""
    figure = frontier_plots.plot_frontiers([found for found, _ in results])
    for axes, (_, peers) in zip(figure.axes, results, strict=False):
        low, high = axes.get_xlim()
        for name, peer in peers.items():
            seconds = np.geomspace(low, high, 100)
            floor, noise = max(mean_of(peer.squares).value, 0.0), mean_of(peer.noise_seconds).value
            style: Any = {"color": COLOURS[name], "label": f"Mitsuba, {name}"}
            axes.plot(seconds, 100.0 * np.sqrt(floor + noise / seconds), linewidth=3.0, alpha=0.35, **style)
            points = [(spent, mean_of(squares).value) for spent, squares in peer.curve]
            points = [(spent, 100.0 * math.sqrt(value)) for spent, value in points if value > 0.0]
            axes.plot(*zip(*points, strict=True), "*", markersize=7, color=COLOURS[name])
        axes.set_ylim(top=2.0 * max(value for _, value in points))
        axes.legend(frameon=False, fontsize=7)
    return figure


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--variant", default="llvm_ad_rgb", help="variant of Mitsuba (llvm_ad_rgb)")
    parser.add_argument("--seconds", type=float, default=150.0, help="of each scene (150)")
    parser.add_argument("--runs", type=int, default=10, help="independent runs (10)")
    parser.add_argument("--out", type=Path, default=Path("bench"), help="folder for the results")
    args = parser.parse_args()
    loader.set_variant(args.variant)
    results = [measure(case, args.seconds, args.runs) for case in CASES]
    text = [
        f"# Mitsuba {mi.__version__}, {args.variant}, on our frontier",
        "",
        "Time to equal noise: to that of our level of the same model, volume or teleport.",
        "",
        "| scene | peer | processor time [s] | its error [%] | +- | our least then [%] | by | times ours "
        "| time to equal noise, times ours |",
        "|---|---|---|---|---|---|---|---|---|",
        *(line for result in results for line in table(*result)),
    ]
    print("\n".join(text))
    args.out.mkdir(parents=True, exist_ok=True)
    with replacing(args.out / "peers.md") as temporary:
        temporary.write_text("\n".join(text) + "\n")
    plots.save(chart(results), args.out / "peers.png")


if __name__ == "__main__":
    main()
