"""Scene: what the integrator knows of one before it follows light, and whether its boundaries and lights will do."""

from typing import Any

import numpy as np

from tsdf.errors import SceneError
from tsdf.loaders.mitsuba.arrays import Arrays
from tsdf.loaders.mitsuba.distances import Distances
from tsdf.loaders.mitsuba.variant import array_of, dr, element, mi, opposite, vectorised

PROBES = 16384, 256  # rays that look for gaps in boundaries, in vectorised and in scalar variants
GAPS = 0.002  # share of them that may slip through an edge
SLACK = 2e-5  # times 1 + the largest coordinate: nearer than that is at a surface; Mitsuba starts rays 9e-5 off it


def state_of(scene: Any) -> list[Any]:
    """Return what tells whether a scene has been changed."""
    state: list[Any] = [scene, len(scene.emitters())]
    for shape in scene.shapes():
        box = shape.bbox()
        state += [tuple(np.array(box.min).ravel()), tuple(np.array(box.max).ravel())]
        if shape.is_mesh() and vectorised() and shape.class_name() != "Rectangle":
            state.append(shape.vertex_positions_buffer().index)
    return state


class Prepared:
    """What the integrator knows of a scene before it follows light."""

    def __init__(self, scene: Any) -> None:
        self.state = state_of(scene)
        shapes: list[Any] = list(scene.shapes())
        media: list[Any] = []
        boundaries: list[list[int]] = []
        for i, shape in enumerate(shapes):
            inside = {id(m): m for m in (shape.interior_medium(), shape.exterior_medium()) if m is not None}
            for found in inside.values():
                if not hasattr(found, "bulk"):
                    raise SceneError(
                        f"shape {shape.id()!r}: the integrator tpt knows only media of type granular, not "
                        f"{found.class_name()}; render with volpath instead"
                    )
                if found not in media:
                    media.append(found)
                    boundaries.append([])
                boundaries[media.index(found)].append(i)
        self.media = media
        self.index: Any = None
        self.arrays: Any = None
        if media:
            self.arrays = Arrays([m.bulk for m in media])
            self.distance = Distances(shapes, boundaries, [m.bulk.radius for m in media])
            if vectorised():
                rows = [int(dr.reinterpret_array(mi.UInt32, mi.MediumPtr(m))[0]) for m in media]
                index = np.full(max(rows) + 1, -1)
                index[rows] = np.arange(len(media))
                self.index = array_of("Int32", index)
        self.shapes = shapes
        inner, outer = (
            [-1 if m is None else media.index(m) for m in sides]
            for sides in ([s.interior_medium() for s in shapes], [s.exterior_medium() for s in shapes])
        )
        self.inner, self.outer = array_of("Int32", inner), array_of("Int32", outer)
        self.bounds = array_of("UInt32", [max(pair) >= 0 for pair in zip(inner, outer, strict=True)])
        self.passes = array_of("UInt32", [lets_through(s.bsdf()) for s in shapes])
        if vectorised() and shapes:
            rows = [int(dr.reinterpret_array(mi.UInt32, mi.ShapePtr(s))[0]) for s in shapes]
            table = np.zeros(max(rows) + 1)
            table[rows] = np.arange(len(shapes))
            self.rows = array_of("UInt32", table)
        box = scene.bbox()
        largest = max(float(np.abs(np.array(c)).max()) for c in (box.min, box.max)) if shapes else 1.0
        self.slack = SLACK * (1.0 + largest)
        self._lights(scene)
        self.dims = bool(media) and self.arrays.absorbs
        if media:
            self._check(scene)

    def _lights(self, scene: Any) -> None:
        all_lights = list(scene.emitters())
        sky = scene.environment()
        self.sky = sky
        self.constant = sky is None or sky.class_name() == "ConstantBackgroundEmitter"
        drawn = [i for i, e in enumerate(all_lights) if e.class_name() != "ConstantBackgroundEmitter"]
        far = [i for i in drawn if mi.has_flag(all_lights[i].flags(), mi.EmitterFlags.Infinite)]
        near = [i for i in drawn if i not in far]
        self.far, self.near = len(far), len(near)
        order = far + near
        if vectorised():
            self.lights: Any = (
                dr.gather(mi.EmitterPtr, scene.emitters_dr(), array_of("UInt32", order)) if order else None
            )
        else:
            self.lights = [all_lights[i] for i in order]
        for i in near:
            if self.media and mi.has_flag(all_lights[i].flags(), mi.EmitterFlags.DeltaPosition):
                raise SceneError(
                    f"emitter {all_lights[i].id()!r} ({all_lights[i].class_name()}) is a point, which no jump of tpt "
                    "can aim at: use a small sphere with an area emitter"
                )

    def number(self, medium: Any) -> Any:
        """Return the number of a medium, -1 for none."""
        if not vectorised():
            return next((i for i, m in enumerate(self.media) if m is medium), -1)
        if self.index is None or medium is None:
            return mi.Int32(-1)
        there = medium != None  # noqa: E711
        return dr.select(there, dr.gather(mi.Int32, self.index, dr.reinterpret_array(mi.UInt32, medium), there), -1)

    def boundary(self, si: Any) -> Any:
        """Return whether a surface lets everything through, as an index-matched boundary does, and its row."""
        if vectorised():
            row = element(mi.UInt32, self.rows, dr.reinterpret_array(mi.UInt32, si.shape))
        else:
            row = next(i for i, s in enumerate(self.shapes) if s is si.shape)
        return element(mi.UInt32, self.passes, row) == 1, row

    def across(self, row: Any, si: Any, d: Any, m: Any) -> Any:
        """Return the medium on the side of a surface to which d goes, m if it bounds none."""
        inside = dr.dot(si.n, d) < 0.0
        after = dr.select(inside, element(mi.Int32, self.inner, row), element(mi.Int32, self.outer, row))
        return dr.select(element(mi.UInt32, self.bounds, row) == 1, after, m)

    def light_is_far(self, ds: Any) -> Any:
        """Return whether a sample is of a light at infinity."""
        return mi.has_flag(ds.emitter.flags(), mi.EmitterFlags.Infinite)

    def light(self, k: Any) -> Any:
        """Return the k-th light that is drawn."""
        return dr.gather(mi.EmitterPtr, self.lights, k) if vectorised() else self.lights[k]

    def _check(self, scene: Any) -> None:
        """Send rays through the whole scene: each must enter a medium before it leaves it, and no other in between."""
        count = PROBES[0] if vectorised() else PROBES[1]
        rng = np.random.default_rng(1)
        boxes = [s.bbox() for s in scene.shapes() if s.interior_medium() is not None or s.exterior_medium() is not None]
        low = np.min([np.array(b.min).ravel() for b in boxes], axis=0)
        high = np.max([np.array(b.max).ravel() for b in boxes], axis=0)
        way = rng.normal(size=(count, 3))
        way /= np.linalg.norm(way, axis=1, keepdims=True)
        start = low + rng.random((count, 3)) * (high - low) - 2.0 * way * np.linalg.norm(high - low)
        if vectorised():
            rays = [mi.Ray3f(mi.Point3f(*start.T.astype(np.float32)), mi.Vector3f(*way.T.astype(np.float32)))]
        else:
            rays = [mi.Ray3f(mi.Point3f(*s), mi.Vector3f(*w)) for s, w in zip(start, way, strict=True)]
        gap, overlap = 0, 0
        for ray in rays:
            a, b = self._crossings(scene, ray)
            gap, overlap = gap + a, overlap + b
        if overlap > GAPS * count:
            raise SceneError(
                f"media overlap: {overlap} of {count} rays enter a granular medium inside another; boundaries must not "
                "cross, and a body inside a medium names that as its exterior medium"
            )
        if gap > GAPS * count:
            raise SceneError(
                f"the boundary of a granular medium is open or inside out: {gap} of {count} rays leave it without "
                "having entered; close the mesh, normals outward"
            )

    def _crossings(self, scene: Any, ray: Any) -> tuple[int, int]:
        inside, active = mi.Int32(-1), mi.Bool(True)
        gap, overlap = mi.Bool(False), mi.Bool(False)
        for _ in range(256):
            si = scene.ray_intersect(ray, active)
            active = active & si.is_valid()
            if not dr.any(active):
                break
            crossing = active & si.is_medium_transition() if vectorised() else active and si.is_medium_transition()
            if vectorised() or crossing:
                before, after = self.number(si.target_medium(-ray.d)), self.number(si.target_medium(ray.d))
                wrong = crossing & (before != inside)
                overlap = overlap | (wrong & (inside >= 0) & (after >= 0))
                gap = gap | (wrong & opposite((inside >= 0) & (after >= 0)))
                inside = dr.select(crossing, after, inside)
            ray = si.spawn_ray(ray.d)
        gap = gap | (inside >= 0)
        return int(np.count_nonzero(np.array(gap))), int(np.count_nonzero(np.array(overlap)))


def lets_through(bsdf: Any) -> bool:
    """Return whether a surface with a BSDF is an index-matched boundary."""
    flags = int(bsdf.flags()) if bsdf is not None else 0
    stops = int(mi.BSDFFlags.Smooth) | int(mi.BSDFFlags.DeltaReflection) | int(mi.BSDFFlags.DeltaTransmission)
    return bool(flags & int(mi.BSDFFlags.Null)) and not flags & stops
