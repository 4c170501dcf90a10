"""Peers on our frontier: Mitsuba's ``volpath`` and our ``tpt``, Blender's Cycles, PhotonTracer, in scenes of `CASES`.

Scenes are measured as `tsdf-frontier` does, and so are the pictures of the peers that can render them (`peers` says
how), against the same truth: error against processor time of all threads, without compiling and making ready. A peer's
picture is the mean of a few, whose spread is its noise. A small sun is met by single grains by chance alone; the truth
is then the best level that aims at it, which leaves out PhotonTracer.
Writes DIR/peers.md and peers.png: each point of a peer beside the least error of our candidates after the same time,
and whether it lies surely below that.

    python benchmarks/bench_peers.py --out bench
    python benchmarks/bench_peers.py --scenes salt-white,beads-near --peers tpt,photontracer --out bench
"""

import argparse
import math
import tempfile
import threading
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import mitsuba as mi
import numpy as np
from peers import Renderer, peers_of, version_of

import tsdf.loaders.mitsuba as loader
from tsdf.data import library
from tsdf.files import replacing
from tsdf.picture import image
from tsdf.picture.render import Picture
from tsdf.picture.world import build
from tsdf.scene.scene import (
    Box,
    Camera,
    ConstantLight,
    EnvironmentLight,
    GrainSpec,
    MediumSpec,
    Mesh,
    Scene,
    Sphere,
    SunLight,
)
from tsdf.scene.specs import Absorption, Light, MediumShape
from tsdf.study import frontier, frontier_plots, plots
from tsdf.study.candidates import Candidate, candidates, taken
from tsdf.study.frontier import Frontier, Left, Measured, Sizing, Way
from tsdf.study.ranking import mean_of, quantile

PARTS = 4  # pictures of a peer in a run
PEERS = ("volpath", "tpt", "cycles", "photontracer")
COLOURS = {"volpath": "#e69f00", "tpt": "#d55e00", "cycles": "#cc79a7", "photontracer": "#000000"}
LONGER = 3.0  # times the time of a candidate that a peer has, for it begins slowly
SURE = 0.025  # [1] chance that a point which is said to lie below our line does not


def grain(name: str, absorption: float = 0.0, fraction: float = 1.0) -> GrainSpec:
    return GrainSpec(library.FOLDER / f"{name}{library.SUFFIX}", fraction, None, Absorption("grey", (absorption,)))


def white(folder: Path) -> tuple[Light, ...]:
    return (ConstantLight((1.0, 1.0, 1.0)),)


def glow(folder: Path) -> tuple[Light, ...]:
    """A sky with a sun so blurred that single grains meet it, and that interpolation between pixels does not matter."""
    height, width = 64, 128
    polar, along = (np.arange(height)[:, None] + 0.5) / height * math.pi, -(np.arange(width) + 0.5) / width * math.tau
    ways = np.stack(np.broadcast_arrays(np.sin(polar) * np.cos(along), np.sin(polar) * np.sin(along), np.cos(polar)))
    toward = np.array([1.0, -0.5, 1.0]) / 1.5
    off = np.degrees(np.arccos(np.clip(np.tensordot(toward, ways, 1), -1.0, 1.0)))
    image.write_exr(folder / "sky.exr", np.repeat((0.3 + 6.0 * np.exp(-((off / 20.0) ** 2)))[..., None], 3, axis=2))
    return (EnvironmentLight(folder / "sky.exr"),)


def sun(folder: Path) -> tuple[Light, ...]:
    toward = np.array([1.0, -0.5, 1.0]) / 1.5
    return (ConstantLight((0.3, 0.3, 0.3)), SunLight((toward[0], toward[1], toward[2]), (2.0, 2.0, 2.0)))


def cube(half: float) -> Box:
    return Box((-half,) * 3, (half,) * 3)


def heap(folder: Path) -> Mesh:
    """A bumpy heap 20 R wide."""
    import trimesh

    ball = trimesh.creation.icosphere(4)
    points = ball.vertices * (10.0, 8.0, 6.0)
    points = points * (1.0 + 0.12 * np.sin(0.5 * points[:, :1]) * np.cos(0.4 * points[:, 1:2]))
    trimesh.Trimesh(points, ball.faces, process=False).export(folder / "heap.ply")
    return Mesh(folder / "heap.ply")


@dataclass(frozen=True)
class Case:
    """A scene: a camera that looks at the middle, a body, its packing fraction, what it is of, and its lights."""

    eye: tuple[float, float, float]
    fov_deg: float
    body: Callable[[Path], MediumShape]
    fraction: float
    grains: tuple[GrainSpec, ...]
    lights: Callable[[Path], tuple[Light, ...]]
    side: int = 32  # pixels

    def scene(self, name: str, folder: Path) -> Scene:
        camera = Camera(self.eye, (0.0, 0.0, 0.0), self.side, self.side, fov_deg=self.fov_deg)
        medium = MediumSpec(self.body(folder), self.fraction, 1.0, self.grains, inside="centres")
        return Scene(camera, self.lights(folder), (medium,), name=name)


CASES = {
    "beads-white": Case((3.0, -30.0, 7.2), 25.0, lambda _: cube(6.0), 0.5, (grain("glass-beads", 0.1),), white),
    "salt-white": Case((6.0, -60.0, 14.4), 25.0, lambda _: cube(12.0), 0.3, (grain("salt", 0.05),), white),
    "snow-heap": Case((5.0, -40.0, 16.0), 32.0, heap, 0.5, (grain("coarse-snow"),), glow),
    "snow-deep": Case((20.0, -190.0, 80.0), 30.0, lambda _: cube(30.0), 0.5, (grain("coarse-snow", 1.1e-4),), glow),
    "salt-thin": Case(
        (4.0, -30.0, 14.0), 40.0, lambda _: Box((-10.0, -10.0, -3.0), (10.0, 10.0, 3.0)), 0.5, (grain("salt"),), glow
    ),
    "beads-near": Case(
        (2.0, -20.0, 9.0), 12.0, lambda _: Sphere((0.0, 0.0, 0.0), 8.0), 0.6, (grain("glass-beads", 0.02),), glow, 48
    ),
    "sugar-dark": Case((6.0, -60.0, 14.4), 25.0, lambda _: cube(10.0), 0.6, (grain("sugar", 0.5),), glow),
    "mixture": Case(
        (6.0, -60.0, 14.4), 25.0, lambda _: cube(10.0), 0.5, (grain("sand", 0.06, 3.0), grain("quartz")), glow
    ),
    "beads-sun": Case((6.0, -60.0, 14.4), 25.0, lambda _: cube(10.0), 0.6, (grain("glass-beads", 0.05),), sun),
    "snow-sun": Case((5.0, -40.0, 16.0), 32.0, heap, 0.5, (grain("coarse-snow"),), sun),
}


class Peer(Way):
    """Another renderer, on its way as a candidate."""

    renderer: Renderer

    def sized(self, seconds: float) -> None:
        """Choose how many samples a picture has; compiles."""
        self.samples, took = 1, 0.0
        self.renderer.shot(1, 0)
        while took < 0.2 * seconds / PARTS and self.samples < 2**20:
            self.samples *= 2
            took = self.renderer.shot(self.samples, 0)[1]
        self.samples = max(1, int(self.samples * seconds / PARTS / took))
        self.renderer.shot(self.samples, 0)  # compiles once more where the number is another

    def add(self, run: int, truth: Picture) -> None:
        """Add a run: a few pictures, and the error of 1, 2, 4 ... of them."""
        shots = [self.renderer.shot(self.samples, 1 + run * PARTS + k) for k in range(PARTS)]
        pictures, spent = np.array([picture for picture, _ in shots]), np.cumsum([took for _, took in shots])
        whole = replace(truth, rgb=pictures.mean(axis=0), variance=pictures.var(axis=0, ddof=1) / PARTS, trust=None)
        whole = replace(whole, samples=np.full(truth.samples.shape, PARTS * self.samples), truncated=0, faults=0)
        self.runs.append(replace(whole, processor_seconds=float(spent[-1])))
        grown = []
        for count in (2**k for k in range(PARTS.bit_length())):
            own = replace(truth, rgb=pictures[:count].mean(axis=0))
            grown.append((float(spent[count - 1]), frontier.square(own, truth, False, 1.0)))
        self.grown.append(grown)


Result = tuple[Frontier, dict[str, tuple[Measured, Measured]]]  # ours, and of each peer, with ours of the same model


def measure(name: str, seconds: float, runs: int, names: Sequence[str], folder: Path) -> Result:
    """Return our frontier, and the numbers of the peers each beside our level of the same model."""
    scene = CASES[name].scene(name, folder)
    renderers, said = peers_of(scene, folder, names)
    print(*said, sep="\n", end="\n" * bool(said), flush=True)
    sized, left = Sizing(seconds / runs, runs, 0, None, threading.Event()), Left()
    truth = frontier.truth_of(scene, sized, left)
    truth.samples = sized.of(truth.world, frontier.TRUTH)
    ways = frontier.possible(scene, candidates(), truth, left, lambda *_: None, sized.stop)
    peers = []
    for renderer in renderers:
        candidate = Candidate(renderer.level)
        if renderer.level == "explicit" and truth.candidate != candidate:
            print(f"{name}: no {renderer.name}: {truth.candidate} is the truth, which is not grain by grain")
            continue
        peer = Peer(candidate, build(taken(scene, candidate), candidate.level), 0)
        peer.renderer = renderer
        peers.append(peer)
    share = 1.0 - frontier.TRUTH
    all_of = len(ways) + LONGER * len(peers)
    ways = frontier.seeing(scene, ways, sized, share * len(ways) / all_of, left)
    packings = frontier.Packings(scene)
    explicit = build(taken(scene, Candidate("explicit")), "explicit")
    for peer in peers:
        peer.renderer.repack(packings.of(explicit, 0))
        peer.sized(LONGER * share * sized.seconds / all_of)
    for run in range(runs):
        for way in (truth, *ways):
            own = None if way is truth else truth.runs[run]
            way.take(packings.of(way.world, run), run, own, 0, None, sized.stop)
        for peer in peers:
            peer.renderer.repack(packings.of(explicit, run))
            peer.add(run, truth.runs[run])
        print(f"{name}: run {run + 1} of {runs}", flush=True)
    scale = float(np.mean([picture.rgb.mean() for picture in truth.runs]))
    whole = {"whole": np.ones((scene.camera.height, scene.camera.width), bool)}
    found = frontier.summed(scene, truth, ways, runs, sized, left)
    print(*found.notes, sep="\n")
    same = {row.candidate: row for row in found.rows}
    measured = {peer.renderer.name: frontier.numbers(peer, truth.runs, whole, scale) for peer in peers}
    return found, {peer: (row, same[row.candidate]) for peer, row in measured.items()}


def table(result: Result) -> list[str]:
    """Return a line for each point of a peer: its error, our least after the same time, and the level that has it."""
    found, peers = result
    lines = []
    for name, (peer, same) in peers.items():
        slower = float(np.median(peer.noise_seconds) / np.median(same.noise_seconds))  # one run may have a firefly
        bias = mean_of(np.array(peer.bias["whole"]) - same.bias["whole"])
        print(f"{found.scene}: {name} takes {slower:.2g} times as long to the noise of our {same.candidate}; "
              f"bias to it {100.0 * bias.value:+.2f} +- {100.0 * bias.error:.2f} %")  # fmt: skip
        for spent, squares in peer.curve:
            value, error = mean_of(squares)
            ours = found.squared_errors(spent)
            first = int(ours.mean(axis=1).argmin())
            least = float(ours[first].mean())
            apart = mean_of(ours[first] - np.array(squares))
            below = apart.value > quantile(found.runs, SURE) * apart.error
            lines.append(
                f"| {found.scene} | {name} | {spent:.3g} | {100.0 * math.sqrt(max(value, 0.0)):.3g} "
                f"| {50.0 * error / math.sqrt(max(value, 1e-30)):.1g} | {100.0 * math.sqrt(least):.3g} "
                f"| {found.rows[first].candidate} | {math.sqrt(max(value, 0.0) / least):.2f}{' **below**' * below} "
                f"| {slower:.2g} |"
            )
    return lines


def chart(results: Sequence[Result]) -> Any:
    """Return our lines with the peers' points and lines over them."""
    figure = frontier_plots.plot_frontiers([found for found, _ in results])
    for axes, (_, peers) in zip(figure.axes, results, strict=False):
        low, high = axes.get_xlim()
        bottom, top = axes.get_ylim()
        for name, (peer, _) in peers.items():
            seconds = np.geomspace(low, high, 100)
            floor, noise = max(mean_of(peer.squares).value, 0.0), mean_of(peer.noise_seconds).value
            if name == "photontracer":
                floor = 0.0  # as that of explicit, which it is but for facets and polarisation
            style: Any = {"color": COLOURS[name], "label": name}
            axes.plot(seconds, 100.0 * np.sqrt(floor + noise / seconds), linewidth=3.0, alpha=0.35, **style)
            points = [(spent, mean_of(squares).value) for spent, squares in peer.curve]
            points = [(spent, 100.0 * math.sqrt(value)) for spent, value in points if value > 0.0]
            axes.plot(*zip(*points, strict=True), "*", markersize=7, color=COLOURS[name])
            top = max(top, 1.5 * max(value for _, value in points))
        axes.set_ylim(bottom, top)
        axes.legend(frameon=False, fontsize=7)
    return figure


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--scenes", default=",".join(CASES), help="which (all)")
    parser.add_argument("--peers", default=",".join(PEERS), help="which (all that are installed)")
    parser.add_argument("--variant", default="llvm_ad_rgb", help="variant of Mitsuba (llvm_ad_rgb)")
    parser.add_argument("--seconds", type=float, default=150.0, help="of each scene (150)")
    parser.add_argument("--runs", type=int, default=10, help="independent runs (10)")
    parser.add_argument("--out", type=Path, default=Path("bench"), help="folder for the results")
    args = parser.parse_args()
    loader.set_variant(args.variant)
    args.out.mkdir(parents=True, exist_ok=True)
    results, lines = [], list[str]()
    head = [
        f"# Peers on our frontier: Mitsuba {mi.__version__} ({args.variant}), Cycles of bpy {version_of('bpy')}, "
        f"PhotonTracer {version_of('photontracer')}",
        "",
        "Below: its error is surely smaller than our least after the same time. Last: processor time to the noise of",
        "our level of the same model, volume, teleport, volume-hg or explicit.",
        "",
        "| scene | peer | processor time [s] | its error [%] | +- | our least then [%] | by | times ours "
        "| time to equal noise, times ours |",
        "|---|---|---|---|---|---|---|---|---|",
    ]
    with tempfile.TemporaryDirectory() as folder:
        for name in args.scenes.split(","):
            results.append(measure(name, args.seconds, args.runs, args.peers.split(","), Path(folder)))
            lines += table(results[-1])
            with replacing(args.out / "peers.md") as temporary:
                temporary.write_text("\n".join([*head, *lines]) + "\n")
            plots.save(chart(results), args.out / "peers.png")
    print("\n".join([*head, *lines]))


if __name__ == "__main__":
    main()
