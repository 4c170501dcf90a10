"""Integrator ``tpt``: teleportation path tracing, and the plugins' classes."""

# ruff: noqa: SIM102 - of nested conditions the outer is decided when a kernel is made, the inner in it
import math
import threading
from typing import Any

from tsdf.errors import UsageError
from tsdf.loaders.mitsuba.arrays import LENGTH, PHI, R, Z
from tsdf.loaders.mitsuba.bulk import bulk_of
from tsdf.loaders.mitsuba.scene import Prepared, state_of
from tsdf.loaders.mitsuba.variant import dr, element, mi, nothing, opposite

DIM = 0.25  # paths dimmer than this may end
FAINT = 0.02  # shadows fainter than this may end


def _reference(p: Any) -> Any:
    """Return an interaction at a point in space, for emitters to be seen from."""
    ref = nothing(mi.Interaction3f)
    ref.p = p
    return ref


def _turned(d: Any, side: Any, cosine: Any, u: Any) -> Any:
    """Return d deflected by an angle of given cosine at azimuth 2 pi u, and the side it goes to."""
    sine, co = dr.sincos(2.0 * math.pi * u)
    a, b = mi.coordinate_system(d)
    side = a * co + b * sine
    return d * cosine + side * dr.safe_sqrt(1.0 - cosine * cosine), side


def _offset(g: Any, c: Any, column: Any, d: Any, side: Any, sampler: Any) -> Any:
    """Return x_o - x_i [scene unit], drawn given the column; `side` is that to which the light is deflected."""
    r, z = g.draw(R, c, column, sampler.next_1d()), g.draw(Z, c, column, sampler.next_1d())
    sine, co = dr.sincos(g.draw(PHI, c, column, sampler.next_1d()))
    across = side * co + dr.cross(d, side) * sine
    return (d * z + across * r) * element(mi.Float, g.radius, c)


@dr.syntax
def _open(  # noqa: PLR0913 - what a vectorised ray knows, each an argument
    k: Any, scene: Any, p: Any, d: Any, distance: Any, m: Any, jump: Any, e: Any, size: Any, length: Any,
    c: Any, sampler: Any, active: Any,
) -> Any:  # fmt: skip
    """Return how much light comes from a distance along d to p in medium m; first of all by a jump along e."""
    p, d, m, jump = mi.Point3f(p), mi.Vector3f(d), mi.Int32(m), mi.Bool(jump)
    distance, active = mi.Float(distance), mi.Bool(active)
    through = dr.select(active, mi.Color3f(1.0), mi.Color3f(0.0))
    g = k.arrays
    while dr.hint(active, label="shadow"):
        reach = dr.select(jump, size + k.slack, distance)
        ray = mi.Ray3f(p, dr.select(jump, e, d), reach, 0.0, [])
        pi = scene.ray_intersect_preliminary(ray, False, active=active)
        hit = pi.is_valid()
        t = dr.select(hit, pi.t, reach)
        if dr.hint(k.media, mode="scalar"):
            if jump:
                if dr.hint(g.absorbs, mode="scalar"):
                    through *= g.kept(c, length * dr.minimum(1.0, t / size))
            else:
                if m >= 0:
                    through *= dr.exp(-t / element(mi.Float, g.free, m))
        if hit:
            si = pi.compute_surface_interaction(ray, mi.RayFlags.Minimal)
            passes, row = k.boundary(si)
            if passes ^ True:
                if jump:
                    through = mi.Color3f(0.0)
                else:
                    seen = pi.compute_surface_interaction(ray)
                    through *= seen.bsdf().eval_null_transmission(seen)
            distance -= dr.select(jump, 0.0, t)
            p = si.spawn_ray(d).o
            m = k.across(row, si, d, m)
        else:
            p = mi.Point3f(p + e * size)
            active &= jump
        jump = mi.Bool(False)
        brightest = dr.max(through)
        active &= brightest > 0.0
        if active & (brightest < FAINT):
            active &= sampler.next_1d() * FAINT < brightest
            through *= FAINT / brightest
            if active ^ True:
                through = mi.Color3f(0.0)
    return through


@dr.syntax
def _light(k: Any, scene: Any, p: Any, count: int, sampler: Any) -> Any:
    """Return a light as seen from p, nothing unless it is of the first `count`: its sample, radiance over density."""
    ref = _reference(p)
    which = dr.minimum(mi.UInt32(sampler.next_1d() * (k.far + k.near)), k.far + k.near - 1)
    ds, light = nothing(mi.DirectionSample3f), mi.Color3f(0.0)
    u = sampler.next_2d()
    if which < count:
        ds, light = k.light(which).sample_direction(ref, u)
        ds.pdf /= k.far + k.near
        light *= k.far + k.near
    return ds, light


@dr.syntax
def trace(  # noqa: C901 - Dr.Jit reads the loop of light and all its branches in one function
    self: Any, k: Any, scene: Any, sampler: Any, ray: Any, medium: Any, active: Any
) -> Any:
    """Return the radiance that arrives along rays, whether they met anything, and how many grains."""
    p, d = mi.Point3f(ray.o), mi.Vector3f(ray.d)
    active = mi.Bool(active)
    g = k.arrays
    m = mi.Int32(k.number(medium))
    radiance, left = mi.Color3f(0.0), mi.Color3f(1.0)
    eta = mi.Float(1.0)
    free, size, length = mi.Float(-1.0), mi.Float(0.0), mi.Float(0.0)
    jump, ready, met = mi.Bool(False), mi.Bool(False), mi.Bool(False)
    wants, asked = mi.Bool(False), mi.Bool(False)  # light from afar at the grain that has been reached
    e, c = mi.Vector3f(0.0, 0.0, 1.0), mi.UInt32(0)
    origin, pdf, pdf_near = mi.Point3f(p), mi.Float(-1.0), mi.Float(-1.0)
    depth, events = mi.UInt32(0), mi.UInt32(0)
    most = mi.UInt32(self.max_depth if self.max_depth >= 0 else 0xFFFFFFFF)

    while dr.hint(active, label="TPT"):
        if dr.hint(k.media, mode="scalar"):
            if active & (m >= 0) & opposite(jump):
                mean = element(mi.Float, g.free, m)
                bound = k.distance(m, p)
                if bound < 0.0:
                    m = mi.Int32(-1)
                    free = mi.Float(-1.0)
                    ready, wants, asked = mi.Bool(False), mi.Bool(False), mi.Bool(False)
                else:
                    free = dr.select(free < 0.0, -mean * dr.log(1.0 - sampler.next_1d()), free)
                    ready = ready | (bound > free)

            if dr.hint(k.far > 0, mode="scalar"):
                if active & wants:
                    c = g.component(m, sampler.next_1d() if g.mixed else mi.Float(0.0))
                    ds, light = _light(k, scene, p, k.far, sampler)
                    toward = ds.d
                    cosine = dr.clip(dr.dot(d, toward), -1.0, 1.0)
                    column = g.column_of(c, cosine)
                    f = element(mi.Float, g.density, column)
                    across = toward - d * cosine
                    width = dr.norm(across)
                    any_side, _ = mi.coordinate_system(d)
                    side = dr.select(width > 1e-6, across / width, any_side)
                    offset = _offset(g, c, column, d, side, sampler)
                    l_shadow = mi.Float(0.0)
                    if dr.hint(g.absorbs, mode="scalar"):
                        l_shadow = g.draw(LENGTH, c, column, sampler.next_1d()) * element(mi.Float, g.radius, c)
                    far = dr.norm(offset)
                    bound = k.distance(m, p)
                    share = g.share(m, bound)
                    weight = f * dr.select(ds.delta, 1.0, ds.pdf / (ds.pdf + f)) / share
                    arriving = light * dr.select(ds.pdf > 0.0, weight, 0.0)
                    blocked = far > bound
                    start = mi.Point3f(dr.select(blocked, p, p + offset))
                    if dr.hint(g.absorbs, mode="scalar"):
                        arriving *= dr.select(blocked, mi.Color3f(1.0), g.kept(c, l_shadow))
                    through = _open(k, scene, start, toward, dr.inf, m, blocked, offset / dr.maximum(far, 1e-30),
                                    far, l_shadow, c, sampler, dr.max(arriving) > 0.0)  # fmt: skip
                    radiance += left * arriving * through
                    asked = mi.Bool(True)
                    ready = mi.Bool(True)
                    wants = mi.Bool(False)

            # Event after event, as long as nothing else can be met
            while dr.hint(active & ready, label="grains"):
                mean = element(mi.Float, g.free, m)
                p = mi.Point3f(p + d * free)
                free = mi.Float(0.0)
                bound = k.distance(m, p)
                if dr.hint(k.far > 0, mode="scalar"):
                    wants = opposite(asked) & (sampler.next_1d() < g.share(m, bound)) & (depth + 1 < most)
                if wants:
                    ready = mi.Bool(False)
                else:
                    if asked ^ True:
                        c = g.component(m, sampler.next_1d() if g.mixed else mi.Float(0.0))
                    asked = mi.Bool(False)
                    column, cosine, f = g.column(c, sampler.next_1d())
                    turned, side = _turned(d, d, cosine, sampler.next_1d())
                    offset = _offset(g, c, column, d, side, sampler)
                    if dr.hint(g.absorbs, mode="scalar"):
                        length = g.draw(LENGTH, c, column, sampler.next_1d()) * element(mi.Float, g.radius, c)
                    d = dr.normalize(turned)
                    pdf = dr.select(f > 0.0, f, -1.0)
                    pdf_near = mi.Float(-1.0)
                    size = dr.norm(offset)
                    depth += 1
                    events += 1
                    met = mi.Bool(True)
                    free = mi.Float(-1.0)
                    jump = bound < size
                    ready = mi.Bool(False)
                    if jump:
                        e = offset / size
                    else:
                        p = mi.Point3f(p + offset)
                        if dr.hint(g.absorbs, mode="scalar"):
                            left *= g.kept(c, length)
                        free = -mean * dr.log(1.0 - sampler.next_1d())
                        ready = k.distance(m, p) > free
                    active &= depth < most
                    if dr.hint(k.dims, mode="scalar"):
                        faint = dr.max(left) * eta * eta
                        if faint < DIM:
                            active &= sampler.next_1d() < 2.0 * faint
                            left /= dr.maximum(2.0 * faint, 1e-30)

        # What is met along a jump or a flight
        ready = mi.Bool(False)
        going = active & opposite(wants)
        reach = dr.select(jump, size, dr.select(m >= 0, free, dr.inf)) + k.slack
        segment = mi.Ray3f(p, dr.select(jump, e, d), reach, 0.0, [])
        pi = scene.ray_intersect_preliminary(segment, False, active=going)
        hit = pi.is_valid()
        if going & hit:
            if dr.hint(k.media and g.absorbs, mode="scalar"):
                if jump:
                    left *= g.kept(c, length * dr.minimum(1.0, pi.t / size))
            si = pi.compute_surface_interaction(segment, mi.RayFlags.Minimal)
            passes, row = k.boundary(si)
            if dr.hint(k.near > 0, mode="scalar"):
                emitter = si.emitter(scene)
                if emitter != None:  # noqa: E711
                    if met | (self.hide_emitters ^ True):
                        ds = mi.DirectionSample3f(scene, si, _reference(origin))
                        p_light = emitter.pdf_direction(_reference(origin), ds) / (k.far + k.near)
                        weight = dr.select(jump | (pdf_near < 0.0), 1.0, pdf_near / (pdf_near + p_light))
                        radiance += left * emitter.eval(si) * weight
            if passes:
                origin = mi.Point3f(dr.select(jump, si.p, origin))
                p = si.spawn_ray(d).o
                m = k.across(row, si, d, m)
            else:
                si = pi.compute_surface_interaction(segment)
                bsdf = si.bsdf()
                met = mi.Bool(True)
                depth += 1
                context = mi.BSDFContext()
                if dr.hint(k.far + k.near > 0, mode="scalar"):
                    if mi.has_flag(bsdf.flags(), mi.BSDFFlags.Smooth) & (depth < most):
                        ds, light = _light(k, scene, si.p, k.far + k.near, sampler)
                        value, density = bsdf.eval_pdf(context, si, si.to_local(ds.d))
                        weight = dr.select(ds.delta, 1.0, ds.pdf / (ds.pdf + density))
                        weight = dr.select(ds.pdf > 0.0, weight, 0.0)
                        arriving = light * value * weight
                        m_shadow = k.across(row, si, ds.d, m)
                        start = si.spawn_ray_to(ds.p)
                        endless = k.light_is_far(ds)
                        distance = dr.select(endless, dr.inf, start.maxt)
                        found = dr.max(arriving) > 0.0
                        through = _open(k, scene, start.o, ds.d, distance, m_shadow, mi.Bool(False), e, size, length,
                                        c, sampler, found)  # fmt: skip
                        radiance += left * arriving * through
                bs, value = bsdf.sample(context, si, sampler.next_1d(), sampler.next_2d())
                left *= value
                eta *= bs.eta
                active &= (bs.pdf > 0.0) & (dr.max(left) > 0.0) & (depth < most)
                d = dr.normalize(si.to_world(bs.wo))
                if mi.has_flag(bs.sampled_type, mi.BSDFFlags.Null):
                    depth -= 1
                else:
                    origin = si.p
                    pdf = dr.select(mi.has_flag(bs.sampled_type, mi.BSDFFlags.Delta), -1.0, bs.pdf)
                    pdf_near = pdf
                p = si.spawn_ray(d).o
                m = k.across(row, si, d, m)
                faint = dr.max(left) * eta * eta
                if faint < DIM:
                    active &= sampler.next_1d() < 2.0 * faint
                    left /= dr.maximum(2.0 * faint, 1e-30)
            free = mi.Float(-1.0)
            jump = mi.Bool(False)
        elif going:
            if jump:
                p = mi.Point3f(p + e * size)
                if dr.hint(k.media and g.absorbs, mode="scalar"):
                    left *= g.kept(c, length)
                jump = mi.Bool(False)
            else:
                if m < 0:
                    if dr.hint(k.sky is not None, mode="scalar"):
                        if met | (self.hide_emitters ^ True):
                            away = nothing(mi.SurfaceInteraction3f)
                            away.wi = -d
                            weight = mi.Float(1.0)
                            if dr.hint(not k.constant, mode="scalar"):
                                ds = nothing(mi.DirectionSample3f)
                                ds.d = d
                                p_light = k.sky.pdf_direction(_reference(p), ds) / (k.far + k.near)
                                weight = dr.select(pdf < 0.0, 1.0, pdf / (pdf + p_light))
                            radiance += left * k.sky.eval(away) * weight
                    active = mi.Bool(False)
                else:
                    ready = mi.Bool(True)
                    if dr.hint(k.far > 0 and k.media, mode="scalar"):
                        p = mi.Point3f(p + d * free)
                        free = mi.Float(0.0)
                        wants = (sampler.next_1d() < g.share(m, k.distance(m, p))) & (depth + 1 < most)
                        asked = opposite(wants)
                        ready = mi.Bool(asked)
    return radiance, met, events


def plugins() -> tuple[Any, Any]:
    """Return the classes of the variant that is set."""

    class Granular(mi.Medium):
        """Grains in bulk; to an integrator that knows no grains, the medium of point scatterers (VPT)."""

        def __init__(self, props: Any) -> None:
            self.bulk = bulk_of(props)
            stock = self.bulk.stock()
            where = props.id()
            for key in list(props.keys()):
                del props[key]
            props["phase"] = mi.load_dict(stock["phase"])
            super().__init__(props)
            self.where = where
            self.sigma_t, self.albedo = (
                [by * float(v) for v in (s["value"] if isinstance(s, dict) else [s] * 3)]
                for s, by in ((stock["sigma_t"], stock["scale"]), (stock["albedo"], 1.0))
            )

        def intersect_aabb(self, ray: Any) -> Any:
            return mi.Bool(True), mi.Float(0.0), mi.Float(math.inf)

        def get_majorant(self, mei: Any, active: Any = True) -> Any:
            return mi.Color3f(self.sigma_t)

        def get_scattering_coefficients(self, mei: Any, active: Any = True) -> Any:
            sigma_t = mi.Color3f(self.sigma_t)
            return sigma_t * mi.Color3f(self.albedo), mi.Color3f(0.0), sigma_t

        def traverse(self, callback: Any) -> None:
            pass

        def to_string(self) -> str:
            return f"Granular[{self.bulk.components}, packing_fraction={self.bulk.packing_fraction:g}]"

    class TPT(mi.SamplingIntegrator):
        """Teleportation path tracing."""

        def __init__(self, props: Any) -> None:
            super().__init__(props)
            self.max_depth = int(props.get("max_depth", -1))
            self.count = bool(props.get("count", False))
            if self.max_depth < -1:
                raise UsageError(f"integrator tpt: max_depth must be >= 0, or -1 for no limit, not {self.max_depth}")
            self._prepared: Prepared | None = None
            self._lock = threading.Lock()

        def prepared(self, scene: Any) -> Prepared:
            with self._lock:
                if self._prepared is None or self._prepared.state[0] is not scene:
                    self._prepared = Prepared(scene)
                return self._prepared

        def render(self, scene: Any, *args: Any, **kwargs: Any) -> Any:
            if self._prepared is not None and self._prepared.state != state_of(scene):
                self._prepared = None
            self.prepared(scene)
            return super().render(scene, *args, **kwargs)

        def sample(self, scene: Any, sampler: Any, ray: Any, medium: Any = None, active: Any = True) -> Any:
            radiance, met, events = trace(self, self.prepared(scene), scene, sampler, ray, medium, active)
            return radiance, met, [mi.Float(events)] if self.count else []

        def aov_names(self) -> list[str]:
            return ["events"] if self.count else []

        def to_string(self) -> str:
            return f"TPT[max_depth={self.max_depth}]"

    return Granular, TPT
