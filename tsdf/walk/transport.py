"""How light crosses a scene: straight flights, grain events, boundaries and surfaces, at every level of detail.

A walker is one sample of one pixel, followed backwards from the camera. All levels share its states: it flies straight,
it jumps from where light enters a grain's bounding sphere to where it leaves it, or it is in a grain of the explicit
level. Deep inside a medium, farther from everything than the next event can take it, it takes step after step without
looking. Near a mesh it looks along short ways by the grid (`grid`); what is long, or starts in an unknown medium, waits
for the ray engine. A shadow is a walker that flies toward a light and loses weight or ends on its way.

The rules at boundaries are those of Meng et al. 2015 (supplemental): a jump that meets a surface ends there, as an
ordinary surface vertex; one that leaves the medium ends on its boundary, which is index-matched. No point is ever moved
but along a segment that is known to be free, so light cannot leak through a surface. Absorption is kept as amounts of
matter crossed and becomes colour when light is found, for all wavelengths at once.
"""

import math
from typing import NamedTuple

import numpy as np

from tsdf.compiled import njit
from tsdf.data.sampler import (
    Tables,
    column_of,
    density,
    draw_column,
    draw_length,
    draw_offset,
    draw_record,
    leave,
    turned,
)
from tsdf.sampling import GOLDEN, key_of, mix, unit
from tsdf.vectors import KERNEL, cross, dot, frame, minus, renewed, step, triple, unit_of
from tsdf.walk import explicit as X
from tsdf.walk import memory as M
from tsdf.walk.geometry import MESH, NONE, Geometry, ball_hit, clearance, exact_hit, unmet
from tsdf.walk.grid import GRAZING, THICK, held, home_of, march, plane_hit, slipped
from tsdf.walk.hybrid import hand_over
from tsdf.walk.leaps import ENDS, LEAPT_ON, NEVER, Leaps, leap, missing, patience
from tsdf.walk.lights import LightArrays
from tsdf.walk.lights import draw as draw_light
from tsdf.walk.lights import radiance as light_from
from tsdf.walk.room import Room
from tsdf.walk.sides import HAIR
from tsdf.walk.walker import (
    ASKED,
    CLEAR,
    DIM,
    ENDED,
    EVENTS,
    FAINT,
    FAULTS,
    FLY,
    GRAIN,
    GRAINS_ASKED,
    HANDED,
    JUMP,
    LIVE,
    LOOK,
    MOST,
    OTHER,
    PATIENCE,
    RAYS,
    TRIES,
    TRUNCATED,
    UNENDING,
    UNKNOWN,
    WAIT,
    Attenuation,
    Media,
    born,
    cast,
    copy,
    find,
    full,
    halves,
    lives,
    write,
)  # fmt: skip

NEXT = 6.0  # [R] how far the next grain is looked for before it is known where the medium ends


class WorldArrays(NamedTuple):
    """What light meets, as kernels ask about it; see `handle`."""

    geometry: Geometry
    room: Room
    media: Media
    tables: Tables
    lights: LightArrays
    grains: X.Grains
    memory: M.Memory
    leaps: Leaps
    absorption: Attenuation


class CameraArrays(NamedTuple):
    """Rays of a picture: along corner + x right + y down from origin + x aside + y below, x in [0, width), y in
    [0, height). A pinhole moves no origins, a parallel beam turns no directions."""

    origin: tuple[float, float, float]
    aside: tuple[float, float, float]
    below: tuple[float, float, float]
    corner: tuple[float, float, float]
    right: tuple[float, float, float]
    down: tuple[float, float, float]
    width: int


NOBODY = np.zeros(0, np.int64)


class Job(NamedTuple):
    """Samples to take: `spp` of each pixel from `pixel` on, or of `pixels` if there are any, the first of them number
    `sample`. Those of each pixel begin as if they had met `met` single grains, by pixel, none where it is empty."""

    camera: CameraArrays
    pixel: int
    spp: int
    sample: int
    seed: int
    met: np.ndarray = NOBODY
    pixels: np.ndarray = NOBODY


@njit(forceinline=True, **KERNEL)
def pixel_of(job, number):
    """Return the pixel of a job of that number."""
    return job.pixels[number] if job.pixels.shape[0] > 0 else job.pixel + number


@njit(forceinline=True, **KERNEL)
def lobe(g, u):
    """Return the cosine drawn from a Henyey-Greenstein phase function."""
    if abs(g) < 1e-6:
        return 1.0 - 2.0 * u
    s = (1.0 - g * g) / (1.0 + g - 2.0 * g * u)
    return min(max((1.0 + g * g - s * s) / (2.0 * g), -1.0), 1.0)


@njit(forceinline=True, **KERNEL)
def lobe_density(g, cosine):
    """Return the Henyey-Greenstein phase function per steradian."""
    s = 1.0 + g * g - 2.0 * g * cosine
    return (1.0 - g * g) / (4.0 * math.pi * s * math.sqrt(s))


@njit(forceinline=True, **KERNEL)
def bent(d, cosine, u):
    """Return d deflected by an angle of given cosine at azimuth 2 pi u."""
    a, b = frame(d)
    c, s = turned(u)
    sine = math.sqrt(max(0.0, 1.0 - cosine * cosine))
    return step(step((cosine * d[0], cosine * d[1], cosine * d[2]), sine * c, a), sine * s, b)


@njit(forceinline=True, **KERNEL)
def offset_of(media, tables, c, column, bits, more):
    """Return r, z, phi_Delta and the path length [R] that two words stand for, given the deflection."""
    if media.traits.joint:
        return draw_record(tables, column, unit(bits))
    u2, u3 = halves(bits)
    u4, u5 = halves(more)
    r, z, phi = draw_offset(tables, column, u2, u3, u4)
    return r, z, phi, draw_length(tables, column, u5) if media.slot[c] >= 0 else 0.0


# ------------------------------------------------------------------------------------- next-event estimation


@njit(forceinline=True, **KERNEL)
def aimed(world, d, c, one, two, bits, more):
    """Return what four words stand for of light that arrives from a light and is deflected by a grain of component c
    into the path of a walker that goes along d.

    That is the direction toward the light, its radiance and weight, 0 where there is nothing to draw; the cosine of
    the deflection, r, z and phi_Delta, and the path length [R], 1 where there are none.
    """
    media, tables = world.media, world.tables
    u0, u1 = halves(one)
    toward, light_pdf, light = draw_light(world.lights, u0, u1, unit(two))
    cosine, column, phase = dot(d, toward), 0, 0.0
    r, z, phi, length = 0.0, 0.0, 0.0, 1.0
    if light_pdf > 0.0:
        if media.traits.tabulated:
            column = column_of(tables, c, min(max(cosine, -1.0), 1.0))
            phase = density(tables, column)
        elif media.traits.lobe:
            phase = lobe_density(media.g[c], cosine)
        else:
            phase = 0.25 / math.pi
    if not phase > 0.0:
        return toward, light, 0.0, cosine, r, z, phi, length
    if media.traits.jumps:
        r, z, phi, length = offset_of(media, tables, c, column, bits, more)
    elif media.traits.tabulated and media.slot[c] >= 0:
        length = draw_length(tables, column, unit(bits))
    return toward, light, phase / (light_pdf + phase), cosine, r, z, phi, length


@njit(forceinline=True, **KERNEL)
def carried(d, toward, cosine, r, z, phi, scale):
    """Return the offset of light that is deflected by a grain of radius `scale` from d to the direction toward a light,
    whose cosine that is."""
    side = step(toward, -cosine, d)
    size = math.sqrt(dot(side, side))
    first, _ = frame(d)
    straight = not size > 1e-12
    side = (
        first[0] if straight else side[0] / size,
        first[1] if straight else side[1] / size,
        first[2] if straight else side[2] / size,
    )
    co, si = turned(phi * (0.5 / math.pi) - math.floor(phi * (0.5 / math.pi)))
    along, aside, up = z * scale, r * co * scale, r * si * scale
    return step(step((along * d[0], along * d[1], along * d[2]), aside, side), up, cross(d, side))


@njit(forceinline=True, **KERNEL)
def connect(world, batch, w, amounts, p, c, share, bound):
    """Send off light that arrives from a light and is deflected into the walker's path by a grain.

    The grain, of component c of the walker's medium, is entered at p by the walker; its key is for this. `share` is
    the probability that this is done at all; nothing is nearer than `bound`.
    """
    media, d = world.media, triple(w.d)
    key = mix(w.key ^ OTHER)
    toward, light, weight, cosine, r, z, phi, length = aimed(
        world, d, c, key, mix(key + GOLDEN), mix(key + GOLDEN + GOLDEN), mix(key + GOLDEN + GOLDEN + GOLDEN)
    )
    if not weight > 0.0:
        return
    key += (np.uint64(2) + np.uint64(media.traits.jumps)) * GOLDEN
    number = born(batch, amounts)
    shadow, its_amounts = batch.out[number], batch.out_amounts[number]
    amount, offset = media.scale[c] * length, (0.0, 0.0, 0.0)
    if media.traits.jumps:
        offset = carried(d, toward, cosine, r, z, phi, media.scale[c])
    if media.slot[c] >= 0:
        its_amounts[media.slot[c]] += amount
    cast(w, shadow, p, toward, light, weight / share, w.medium, key)
    size = math.sqrt(dot(offset, offset))
    if size > 0.0:
        if size < bound:
            write(shadow.p, step(p, 1.0, offset))
        else:
            aim(shadow, offset, size, toward, amount, c)
            g, end = world.geometry, step(p, size, triple(shadow.e))
            if g.convex:
                sure = held(g.grid, w.medium, end)
            else:
                sure = bound > 0.0 and alone(g, w.medium) and clearance(g, w.medium, end) > HAIR * g.slack[w.medium]
            if sure:
                shadow.mode = FLY
                write(shadow.p, end)


@njit(**KERNEL)
def aim(w, offset, size, d_out, amount, c):
    """Begin a jump of given size along an offset of any length."""
    w.mode, w.length, w.gained, w.component = JUMP, size, amount, c
    write(w.e, unit_of(offset))
    write(w.q, d_out)


# ------------------------------------------------------------------------------------------ deep inside


@njit(forceinline=True, **KERNEL)
def deflection(world, c, u0, key):
    """Return what `deflected` does for the words that follow a key, and the key that is used up."""
    cosine, pdf, r, z, phi, length = deflected(world, c, u0, mix(key + GOLDEN), mix(key + GOLDEN + GOLDEN))
    return cosine, pdf, r, z, phi, length, key + words_of(world.media.traits) * GOLDEN


@njit(forceinline=True, **KERNEL)
def words_of(traits):
    """Return how many words `deflected` takes."""
    two = traits.jumps and not traits.joint
    return np.uint64(traits.tabulated) + np.uint64(traits.tabulated and two)


@njit(forceinline=True, **KERNEL)
def deflected(world, c, u0, bits, more):
    """Return the cosine of the deflection by a grain of component c that u0 stands for, its density per steradian, -1
    for an atom, and r, z, phi_Delta and path length [R], 1 where there are none, that two words stand for."""
    media, tables = world.media, world.tables
    traits, slot = media.traits, media.slot[c]
    r, z, phi, length = 0.0, 0.0, 0.0, 1.0
    if traits.tabulated:
        column, cosine = draw_column(tables, c, u0)
        pdf = density(tables, column)
        if pdf <= 0.0:
            pdf = -1.0
        if traits.joint:
            r, z, phi, length = draw_record(tables, column, unit(bits))
        elif traits.jumps:
            u2, u3 = halves(bits)
            u4, u5 = halves(more)
            r, z, phi = draw_offset(tables, column, u2, u3, u4)
            if slot >= 0:
                length = draw_length(tables, column, u5)
        elif slot >= 0:
            length = draw_length(tables, column, unit(bits))
    elif traits.lobe:
        cosine = lobe(media.g[c], u0)
        pdf = lobe_density(media.g[c], cosine)
    else:
        cosine, pdf = 1.0 - 2.0 * u0, 0.25 / math.pi
    return cosine, pdf, r, z, phi, length


@njit(**KERNEL)
def alone(g, m):
    """Return whether nothing is in the scene but medium m in an exact shape, all of which are convex: what begins and
    ends in it is in it all the way."""
    return g.kind.shape[0] == 1 and g.kind[m] != MESH and g.balls.shape[0] == 0 and not g.solid


@njit(**KERNEL)
def wander(world, batch, w, amounts, once):  # noqa: C901 - all that can become of a walker, in one loop
    """Take a walker that is in a known medium from event to event while nothing else can be met.

    With `once` it is known that the walker reaches the end of its free path: one event. A flight that may meet
    something is left to `fly`, a jump to `land`. Returns LOOK, WAIT or ENDED.
    """
    g, media, absorption, sampled = world.geometry, world.media, world.absorption, world.lights.sampled
    m = w.medium
    p, d, key, free = triple(w.p), triple(w.d), w.key, w.free
    mean, reach, travel = media.free[m], media.reach[m], media.travel[m]
    first, last = media.first[m], media.first[m] + media.kinds[m] - 1
    luck, pdf, steps, leapt, state = w.luck, w.pdf, 0, 0, LOOK
    most, spot = min(PATIENCE, media.limit - w.events), batch.hits.shape[0] - 1
    bound, fresh = 0.0 if once else clearance(g, m, p), True
    convex, hair = alone(g, m), HAIR * g.slack[m]
    again = NEVER if once else patience(world.leaps, m, missing(world.leaps, m, bound))
    while True:
        if free < 0.0:
            key += GOLDEN
            free = -mean * math.log(1.0 - unit(mix(key)))
        if not once and bound <= free:
            if not fresh and (bound <= 0.0 or not convex):
                bound = clearance(g, m, p, free)
            if bound <= free:
                if convex:
                    there = clearance(g, m, step(p, free, d)) - hair
                    if bound <= 0.0 or there <= 0.0:
                        break
                    bound = there + free
                else:
                    sure, known = unmet(g, batch.hits[spot], m, p, d, free)
                    if not sure:
                        w.ray = spot if known else NONE
                        break
        if steps >= most or (not once and full(batch)):
            state = WAIT
            break
        fresh = False
        steps += 1
        p = step(p, free, d)
        bound -= free
        if travel >= 0:
            amounts[travel] += free
            luck += absorption.least[travel] * free
        free = -1.0
        if steps >= again:
            write(w.p, p)
            write(w.d, d)
            w.key, w.luck, w.pdf = key, luck, pdf
            wait, bound_there = leap(world, batch, w, amounts)
            again = steps + wait
            if wait <= LEAPT_ON:
                leapt += 1
                p, d, key, free, luck, pdf = triple(w.p), triple(w.d), w.key, w.free, w.luck, w.pdf
                if wait == ENDS:
                    state = ENDED
                    break
                bound, most = bound_there, min(most, media.limit - w.events + leapt)
                continue

        c = first
        if last > first:
            key += GOLDEN
            u = unit(mix(key))
            while c < last and u >= media.choice[c]:
                c += 1
        if sampled:
            if bound < 8.0 * mean:
                bound = max(bound, clearance(g, m, p, reach))
            share = math.exp((reach - bound) / mean) if reach < bound else 1.0
            key += GOLDEN
            if unit(mix(key)) < share:
                write(w.d, d)
                w.key = key
                connect(world, batch, w, amounts, p, c, share, bound)

        key += GOLDEN
        u0, u1 = halves(mix(key))
        cosine, pdf, r, z, phi, length, key = deflection(world, c, u0, key)
        d, offset = leave(d, cosine, u1, r, z, phi)
        d = renewed(d)
        scale = media.scale[c]
        if media.slot[c] >= 0:
            length *= scale
            amounts[media.slot[c]] += length
            luck += absorption.least[media.slot[c]] * length
        if reach > 0.0:
            size = scale * math.sqrt(dot(offset, offset))
            if bound <= size and (bound <= 0.0 or not convex):
                bound = clearance(g, m, p, size)
            there = bound - size
            if there > 0.0 or size == 0.0:
                p, bound = step(p, scale, offset), there
            else:
                e = unit_of(offset)
                end, sure, known = step(p, size, e), False, False
                if convex:
                    there = clearance(g, m, end) - hair
                    sure = bound > 0.0 and there > 0.0
                else:
                    sure, known = unmet(g, batch.hits[spot], m, p, e, size)
                    there = 0.0
                if sure:
                    p, bound = end, there
                else:
                    aim(w, offset, size, d, length, c)
                    w.ray = spot if known else NONE
                    once = True
        if luck < DIM and w.mode != JUMP:  # a jump that ends on a boundary gives some of its length back
            w.luck = luck
            key += GOLDEN
            if not lives(w, key):
                state = ENDED
                break
            luck = w.luck
        if once:
            break
    batch.counters[EVENTS] += steps - leapt
    w.events += steps - leapt
    write(w.p, p)
    write(w.d, d)
    w.key, w.free, w.luck, w.pdf = key, free, luck, pdf
    if state != ENDED and w.events >= media.limit:
        batch.counters[TRUNCATED] += 1
        state = ENDED
    return state


# ---------------------------------------------------------------------------------------- where things are


@njit(forceinline=True, **KERNEL)
def surface_met(g, p, d, hits, ray):
    """Return distance to the next opaque surface, its number, its normal against d, its thickness, and whether the ray
    engine named a facet that is behind p."""
    best, which, n, slack = math.inf, NONE, (0.0, 0.0, 0.0), 0.0
    if g.solid and hits[ray, 0] >= 0:
        facet = hits[ray, 0]
        facets = g.grid.facets
        t, cosine = plane_hit(facets, facet, p, d)
        slack, n = facets[facet, THICK], (facets[facet, 0], facets[facet, 1], facets[facet, 2])
        if t < 0.0:
            return best, which, n, slack, True
        if t < math.inf:
            best, which = t, g.surface[facet]
            if cosine > 0.0:
                n = minus(n)
    if g.balls.shape[0] > 0:
        t, ball = ball_hit(g.balls, p, d)
        if t < best:
            centre, radius = (g.balls[ball, 0], g.balls[ball, 1], g.balls[ball, 2]), g.balls[ball, 3]
            x = step(step(p, t, d), -1.0, centre)
            n = (x[0] / radius, x[1] / radius, x[2] / radius)
            if dot(n, d) > 0.0:
                n = minus(n)
            best, which, slack = t, g.ball_surface[ball], 1e-9 * (radius + abs(p[0]) + abs(p[1]) + abs(p[2]))
    return best, which, n, slack, False


@njit(forceinline=True, **KERNEL)
def boundary_met(g, m, p, d, hits, ray, known):
    """Return distance to the next boundary of medium m, whether the ray is inside until then, the outward normal, the
    boundary's thickness, and whether the ray engine named a facet that is behind p. Where no facet is met, the ray is
    inside if that is `known`."""
    if g.kind[m] != MESH:
        t, inside, n = exact_hit(g.kind[m], g.shape[m], p, d)
        return t, inside, n, g.slack[m], False
    facet = hits[ray, g.engine[m]]
    if facet < 0:
        return math.inf, known, (0.0, 0.0, 0.0), 0.0, False
    facets = g.grid.facets
    t, cosine = plane_hit(facets, facet, p, d)
    n = (facets[facet, 0], facets[facet, 1], facets[facet, 2])
    return t, cosine > 0.0, n, facets[facet, THICK], t < 0.0


@njit(**KERNEL)
def look(world, batch, w):
    """See what a walker in a known medium meets next without the ray engine, and write it where answers of the ray
    engine stand; return whether that was done. A flight ends with its free path, a jump with its length."""
    g, traits = world.geometry, world.media.traits
    end, way = math.inf, triple(w.d)
    if w.mode == JUMP:
        end, way = w.length, triple(w.e)
    elif w.shadow and not traits.remembers:  # farther, it will not survive its roulette; see `pass_through`
        end = world.media.free[w.medium] * math.log(w.weight / (FAINT * unit(mix(w.key + GOLDEN)) + 1e-300))
    elif w.free >= 0.0:
        end = w.free
    spot = batch.hits.shape[0] - 1
    if not march(g.grid, batch.hits[spot], w.medium, triple(w.p), way, max(end, 0.0)):
        return False
    w.ray = spot
    return True


@njit(**KERNEL)
def beyond(slack, cosine):
    """Return how far along a ray a point is to be moved to be clear of a facet."""
    return slack * min(1.0 / abs(cosine), GRAZING)


# ------------------------------------------------------------------------------------------- one walker


@njit(**KERNEL)
def bounce(world, batch, w, amounts, d, met):
    """Put a walker on a diffuse surface that it meets along d and send it on; return what becomes of it."""
    t, surface, n, slack = met
    p = step(triple(w.p), max(t - beyond(slack, dot(n, d)), 0.5 * t), d)
    before = max(w.colour[0], w.colour[1], w.colour[2])
    for k in range(3):
        w.colour[k] *= world.geometry.reflectance[surface, k]
    after = max(w.colour[0], w.colour[1], w.colour[2])
    if after <= 0.0:
        w.weight = 0.0
        return ENDED
    w.events += 1
    w.key += GOLDEN
    u0, u1 = halves(mix(w.key))
    if world.lights.sampled:
        w.key += GOLDEN
        u2, u3 = halves(mix(w.key))
        w.key += GOLDEN
        toward, light_pdf, light = draw_light(world.lights, u2, u3, unit(mix(w.key)))
        cosine = dot(n, toward)
        if light_pdf > 0.0 and cosine > 0.0:
            scattered = cosine / math.pi
            shadow = batch.out[born(batch, amounts)]
            cast(w, shadow, p, toward, light, scattered / (light_pdf + scattered), UNKNOWN,
                 mix(w.key ^ OTHER))  # fmt: skip
    cosine = math.sqrt(1.0 - u0)
    d = bent(n, cosine, u1)
    write(w.p, p)
    write(w.d, renewed(d))
    w.mode, w.medium, w.free, w.skip, w.pdf = FLY, UNKNOWN, -1.0, 0.0, cosine / math.pi
    w.luck += math.log(after / before)
    if w.luck < DIM:
        w.key += GOLDEN
        if not lives(w, w.key):
            return ENDED
    return LOOK


@njit(forceinline=True, **KERNEL)
def escape(world, batch, w, amounts):
    """End a walker that meets nothing more in the light that it finds."""
    if w.shadow:
        find(world, batch, w, amounts, (1.0, 1.0, 1.0))
    else:
        find(world, batch, w, amounts, light_from(world.lights, triple(w.d), w.pdf))
    return ENDED


@njit(**KERNEL)
def again(batch, w, way, n, slack):
    """Take a walker's next ray from beyond a facet, of normal n, that the ray engine sees and that is behind it: from
    farther along its way, and where it leaves along the facet from off it."""
    w.tries += 1
    if w.tries <= TRIES:
        w.skip = max(2.0 * w.skip, slack)
        return LOOK
    cosine = dot(n, way)
    if w.tries > 2 * TRIES or 4.0 * abs(cosine) > 1.0:
        batch.counters[FAULTS] += 1
        w.weight = 0.0
        return ENDED
    write(w.p, step(triple(w.p), math.copysign(slack, cosine), n))
    w.skip = slack
    return LOOK


@njit(**KERNEL)
def land(world, batch, w, amounts):
    """End a walker's jump; return what becomes of it."""
    g, media, hits = world.geometry, world.media, batch.hits
    p, e, m = triple(w.p), triple(w.e), w.medium
    t, surface, n, slack, spurious = surface_met(g, p, e, hits, w.ray)
    if spurious:
        return again(batch, w, e, n, slack)
    known = w.ray == hits.shape[0] - 1
    t_b, inside, n_b, slack_b, spurious = boundary_met(g, m, p, e, hits, w.ray, known)
    if spurious:
        return again(batch, w, e, n_b, slack_b)
    w.skip, w.tries = 0.0, 0
    if not inside:  # by rounding: the jump begins on the boundary
        t_b = 0.0
    leaves = t_b < w.length
    end = min(w.length, t_b)
    slot = media.slot[w.component]
    if t < math.inf and (t - end) * abs(dot(n, e)) <= slack:
        if w.shadow:
            return ENDED
        if slot >= 0:
            back = w.gained * max(0.0, 1.0 - t / w.length)
            amounts[slot] -= back
            w.luck -= world.absorption.least[slot] * back
        return bounce(world, batch, w, amounts, e, (t, surface, n, slack))
    move = min(beyond(slack_b, dot(n_b, e)), 0.5 * (t - t_b)) if inside else 0.0
    if leaves:
        for k in range(g.kind.shape[0]):
            t_k, within, n_k, slack_k, spurious = boundary_met(g, k, p, e, hits, w.ray, False)
            if k != m and not within and not spurious and abs(t_k - t_b) * abs(dot(n_k, e)) <= slack_b + slack_k:
                # Another medium begins where this one ends: the grain lies in both
                gone = min(t_b + move, w.length)
                write(w.p, step(p, gone, e))
                w.gained *= 1.0 - gone / w.length
                w.medium, w.length = k, w.length - gone
                return LOOK
    write(w.d, triple(w.q))
    w.mode, w.free = FLY, -1.0
    if leaves:
        if slot >= 0:
            back = w.gained * (1.0 - t_b / w.length)
            amounts[slot] -= back
            w.luck -= world.absorption.least[slot] * back
        outward = dot(triple(w.q), n_b)
        if outward < 0.0:
            move = -min(move, 0.5 * t_b)
        write(w.p, step(p, t_b + move, e))
        w.medium = UNKNOWN
        if inside and outward > 0.0 and (g.convex or alone(g, m)):
            return escape(world, batch, w, amounts)
    else:
        write(w.p, step(p, w.length, e))
    return LOOK


@njit(**KERNEL)
def fly(world, batch, w, amounts):
    """Take a walker along its straight flight to what comes first; return what becomes of it."""
    g, media, hits = world.geometry, world.media, batch.hits
    p, d = triple(w.p), triple(w.d)
    t, surface, n, slack, spurious = surface_met(g, p, d, hits, w.ray)
    if spurious:
        return again(batch, w, d, n, slack)
    home, t_b, n_b, slack_b = NONE, math.inf, n, 0.0
    for m in range(g.kind.shape[0]):
        known = m == w.medium and w.ray == hits.shape[0] - 1
        t_m, inside, n_m, slack_m, spurious = boundary_met(g, m, p, d, hits, w.ray, known)
        if spurious:
            return again(batch, w, d, n_m, slack_m)
        if home == NONE and (inside or t_m < t_b):
            unsure = inside and w.medium == UNKNOWN and g.kind[m] == MESH
            if unsure and slipped(g.grid, hits[hits.shape[0] - 1], m, p, GRAZING * slack_m):
                continue
            t_b, n_b, slack_b = t_m, n_m, slack_m
            if inside:
                home = m
    if home != w.medium:
        w.free, w.left = -1.0, 0
    w.skip, w.tries, w.medium = 0.0, 0, home
    facing = abs(dot(n, d)) if t < math.inf else 1.0
    if home != NONE:
        state = pass_through(world, batch, w, amounts, t_b - HAIR * beyond(slack_b, dot(n_b, d)), t, slack / facing)
        if state != CLEAR:
            return state
    w.free = -1.0
    if t < math.inf and (t - t_b) * facing <= slack:
        if w.shadow:
            return ENDED
        return bounce(world, batch, w, amounts, d, (t, surface, n, slack))
    if t_b < math.inf:
        write(w.p, step(p, t_b + min(beyond(slack_b, dot(n_b, d)), 0.5 * (t - t_b)), d))
        w.medium = UNKNOWN
        w.events += 1
        if w.events >= media.limit:
            batch.counters[TRUNCATED] += 1
            return ENDED
        if home != NONE:
            if g.convex or alone(g, 0):
                return escape(world, batch, w, amounts)
        elif alone(g, 0):
            w.medium = 0
        elif g.engines > 0:  # it enters a medium, but that it may have met a corner
            home = home_of(g.grid, hits[hits.shape[0] - 1], triple(w.p))
            if home != NONE:
                w.medium = home
        return LOOK
    return escape(world, batch, w, amounts)


@njit(forceinline=True, **KERNEL)
def pass_through(world, batch, w, amounts, t_b, t, thick):
    """Take a walker through the medium that it is in, whose boundary is at distance t_b and, if at all, a surface at t,
    that thick along the ray; return CLEAR if it comes through, else what becomes of it."""
    media, m, end = world.media, w.medium, min(t, t_b)
    if media.traits.packed:
        if media.free[m] >= UNENDING:  # no grain fits in: lights are aimed at through it
            return CLEAR
        if w.shadow:
            return ENDED
        w.pdf = -1.0
        if w.free < 0.0:
            X.find(world.grains, world.room, w, end)
        if 0.0 <= w.free < end and t - w.free > thick:
            enter(world, w)
            return LOOK
        w.left = 0
    elif media.traits.remembers:
        if w.free < 0.0:
            M.begin(w, world.memory)
        if w.free < t_b and t - w.free > thick:
            state = M.roam(world, batch, w, amounts, True)
            return ENDED if state == ENDED else LOOK
    elif w.shadow:
        w.weight *= math.exp(-end / media.free[m])
        if media.travel[m] >= 0:
            amounts[media.travel[m]] += end
        if w.weight < FAINT:
            w.key += GOLDEN
            if unit(mix(w.key)) * FAINT >= w.weight:
                return ENDED
            w.weight = FAINT
    else:
        if w.free < 0.0:
            w.key += GOLDEN
            w.free = -media.free[m] * math.log(1.0 - unit(mix(w.key)))
        if w.free < t_b and t - w.free > thick:
            state = wander(world, batch, w, amounts, True)
            return ENDED if state == ENDED else LOOK
        if media.travel[m] >= 0:
            amounts[media.travel[m]] += end
            w.luck += world.absorption.least[media.travel[m]] * end
    return CLEAR


@njit(**KERNEL)
def enter(world, w):
    """Bring a walker to the bounding sphere of the grain that was found and, if the grain is traced, into its frame."""
    grains, media, m, centre, d = world.grains, world.media, w.medium, triple(w.e), triple(w.d)
    radius = grains.radius[m]
    w.component = X.component_of(grains, media.first[m], media.kinds[m], w.grain)
    w.mode, w.state, w.left, w.facet, w.pdf, w.ray = GRAIN, X.ENTERED, w.facet, NONE, -1.0, NONE
    write(w.q, centre)
    x = step(triple(w.p), w.free, d)
    if media.traits.answered:
        write(w.p, x)
        return
    x = step(x, -1.0, centre)
    x = (x[0] / radius, x[1] / radius, x[2] / radius)
    x = unit_of(x)
    axis, w.b = (0.0, 0.0, 0.0), 1.0
    if grains.exemplar[w.component] != X.EXACT_SPHERE:  # which looks the same from all sides
        a, b, c, w.b = X.rotation(w.grain)
        axis = (a, b, c)
        back = (-a, -b, -c)
        x, d = X.rotated(back, w.b, x), X.rotated(back, w.b, d)
    write(w.t, axis)
    write(w.p, x)
    write(w.e, x)
    write(w.d, d)


@njit(**KERNEL)
def in_grain(world, batch, w, amounts, facet):
    """Take a walker through the next hit in its grain; return what becomes of it."""
    grains, media, c = world.grains, world.media, w.component
    p, d = triple(w.p), triple(w.d)
    met = w.facet >= 0 or facet >= 0
    if grains.exemplar[c] == X.EXACT_SPHERE:
        p, d, length, w.key = X.through_sphere(p, d, grains.eta[c], grains.kept_apart[c], w.key)
        state = X.LEFT
    else:
        p, d, length, state, fault = X.at_facet(grains, w, facet)
        if fault:
            batch.counters[FAULTS] += 1
    if media.slot[c] >= 0 and length > 0.0:
        amounts[media.slot[c]] += media.scale[c] * length
        w.luck += world.absorption.least[media.slot[c]] * media.scale[c] * length
    w.state, w.ray = state, NONE
    if state & X.LEFT == 0:
        write(w.p, p)
        write(w.d, d)
        return LOOK
    if met or grains.exemplar[c] == X.EXACT_SPHERE:
        batch.counters[EVENTS] += 1
        w.events += 1
        w.single += 1
    p = step(p, X.rim_of(p, d), d)
    axis = triple(w.t)
    write(w.p, step(triple(w.q), grains.radius[w.medium], X.rotated(axis, w.b, p)))
    write(w.d, renewed(X.rotated(axis, w.b, d)))
    w.mode, w.free = FLY, -1.0
    if w.events >= media.limit:
        batch.counters[TRUNCATED] += 1
        return ENDED
    if w.luck < DIM:
        w.key += GOLDEN
        if not lives(w, w.key):
            return ENDED
    return LOOK if w.single < media.singles else HANDED


@njit(**KERNEL)
def meet_grain(world, batch, w, amounts):
    """Take a walker on in its grain, or ask for the facet that it meets or the record; return what becomes of it."""
    if w.state & X.LEFT:  # `packed` or `standing` have taken it to its end, between two turns
        w.mode = FLY
        return ENDED
    if world.media.traits.answered:
        return WAIT
    grains, facet = world.grains, NONE
    e = grains.exemplar[w.component]
    if e != X.EXACT_SPHERE:
        if grains.first_side[e] < grains.first_side[e + 1]:
            facet = X.side_met(grains, e, w)
        elif w.ray >= 0:
            facet = batch.grain_hits[e, w.ray]
        else:
            w.ray = batch.asked[GRAINS_ASKED + e]
            for k in range(3):
                batch.grain_starts[e, w.ray, k], batch.grain_ways[e, w.ray, k] = w.e[k], w.d[k]
            batch.asked[GRAINS_ASKED + e] += 1
            return WAIT
    return in_grain(world, batch, w, amounts, facet)


@njit(**KERNEL)
def go_to_grain(world, w):
    """Take a walker in a known medium to the next grain if that is surely nearer than all else; return LOOK, or CLEAR
    if it must look, for which the grain is kept if one was found, and that there is none if that is sure."""
    g, m = world.geometry, w.medium
    bound = clearance(g, m, triple(w.p))
    if not bound > 0.0 or world.media.free[m] >= UNENDING:
        return CLEAR
    far, end = max(bound, NEXT * world.grains.radius[m]), math.inf
    if g.kind[m] != MESH:
        t, inside, _ = exact_hit(g.kind[m], g.shape[m], triple(w.p), triple(w.d))
        if inside and t < math.inf:
            far = end = t
            if alone(g, m):
                bound = max(bound, t - HAIR * GRAZING * g.slack[m])
    X.find(world.grains, world.room, w, far)
    if 0.0 <= w.free < bound:
        enter(world, w)
        return LOOK
    if w.free < 0.0 and far == end:
        w.free = math.inf
    return CLEAR


@njit(**KERNEL)
def go_deep(world, batch, w, amounts):
    """Take a walker in a known medium as far as it is sure to meet nothing; return CLEAR if it must look, else what
    becomes of it."""
    if world.media.traits.packed:
        return go_to_grain(world, w)
    if w.skip != 0.0:
        return CLEAR
    if world.media.traits.remembers:
        state = M.roam(world, batch, w, amounts, False)
    else:
        state = wander(world, batch, w, amounts, False)
    return CLEAR if state == LOOK else state


@njit(**KERNEL)
def ask(batch, w):
    """Have the ray engine told what a walker looks along."""
    way = triple(w.e) if w.mode == JUMP else triple(w.d)
    w.ray = batch.asked[ASKED]
    write(batch.starts[w.ray], step(triple(w.p), w.skip, way))
    write(batch.ways[w.ray], way)
    batch.asked[ASKED] += 1


@njit(**KERNEL)
def follow(world, batch, w, amounts):
    """Take a walker as far as it comes without the ray engine; return ENDED, WAIT, or HANDED where the world's law ends
    and another's begins."""
    engines, turns = world.geometry.engines > 0, 0
    while True:
        if w.mode == GRAIN:
            state = meet_grain(world, batch, w, amounts)
            if state != LOOK:
                return state
            continue
        if w.mode == FLY and w.ray < 0 and w.medium >= 0 and (not w.shadow or world.media.traits.remembers):
            state = go_deep(world, batch, w, amounts)
            if state == LOOK:
                turns += 1
                if turns > PATIENCE:
                    return WAIT
                continue
            if state != CLEAR:
                return state
        turns += 1
        if (full(batch) and not w.shadow) or turns > PATIENCE:
            w.ray = NONE  # by the next turn its answer is another's
            return WAIT
        if engines and w.ray < 0 and (w.medium < 0 or not look(world, batch, w)):
            ask(batch, w)
            return WAIT
        state = land(world, batch, w, amounts) if w.mode == JUMP else fly(world, batch, w, amounts)
        w.ray = NONE
        if state == ENDED:
            return ENDED


@njit(**KERNEL)
def conduct(near, world, near_batch, batch, w, amounts):
    """Take a walker as far as it comes without the ray engine, through single grains while it has some to meet, then
    through the world; return ENDED or WAIT."""
    if w.single < world.media.singles:
        state = follow(near, near_batch, w, amounts)
        if state != HANDED:
            return state
        hand_over(world, w)
    return follow(world, batch, w, amounts)


@njit(**KERNEL)
def keep(batch, w, amounts):
    """Have a walker go on in the next turn."""
    live = batch.asked[LIVE]
    batch.out[live] = w
    copy(batch.out_amounts[live], amounts)
    batch.asked[LIVE] += 1


@njit(**KERNEL)
def advance(near, world, near_batch, batch, count):
    """Take each walker of a batch, the first `count`, as far as it comes without the ray engine.

    `near` is the world of single grains, met first, and the same world where these are all there is, or not there.
    `near_batch` has its answers of the ray engine, and is the same batch where places are the same.
    What goes on is written to `out` and `out_amounts`, the rays it needs to `starts` and `ways`, and for the exemplars
    to `grain_starts` and `grain_ways`; `asked` tells how many. What has ended stays in `walkers`, the number of its
    sample inverted (~sample); but for shadows, its weight is 0 unless it left the scene or reached the limit of events.
    """
    asked = batch.asked
    for i in range(asked.shape[0]):
        asked[i] = 0
    for i in range(count):
        w, amounts = batch.walkers[i], batch.amounts[i]
        asked[MOST] = batch.out.shape[0] - (count - i) - 2
        first = asked[LIVE]
        state = conduct(near, world, near_batch, batch, w, amounts)
        # The shadows that were born on the way
        last, asked[LIVE] = asked[LIVE], first
        for k in range(first, last):
            if conduct(near, world, near_batch, batch, batch.out[k], batch.out_amounts[k]) != ENDED:
                keep(batch, batch.out[k], batch.out_amounts[k])
        if state == ENDED:
            w.sample = ~w.sample
        else:
            keep(batch, w, amounts)
    batch.counters[RAYS] += asked[ASKED]


@njit(**KERNEL)
def spawn(batch, live, job, first, count):
    """Start walkers, behind the first `live`, for the samples first .. first + count - 1 of a job: sample i is of its
    pixel number i // spp."""
    camera = job.camera
    for i in range(count):
        local = first + i
        pixel = pixel_of(job, local // job.spp)
        w = batch.walkers[live + i]
        key = key_of(job.seed, pixel, job.sample + local % job.spp)
        u0, u1 = halves(mix(key + GOLDEN))
        x, y = float(pixel % camera.width) + u0, float(pixel // camera.width) + u1
        d = step(step(camera.corner, x, camera.right), y, camera.down)
        size = 1.0 / math.sqrt(dot(d, d))
        write(w.p, step(step(camera.origin, x, camera.aside), y, camera.below))
        write(w.d, (d[0] * size, d[1] * size, d[2] * size))
        for k in range(3):
            w.colour[k] = 1.0
        w.weight, w.luck, w.pdf, w.free, w.skip = 1.0, 0.0, -1.0, -1.0, 0.0
        w.key, w.events, w.sample, w.ray, w.medium, w.mode = key + GOLDEN, 0, local, NONE, UNKNOWN, FLY
        w.tries, w.shadow, w.single, w.left = 0, 0, 0, 0
        if job.met.shape[0] > 0:
            w.single = job.met[pixel]
        for k in range(batch.amounts.shape[1]):
            batch.amounts[live + i, k] = 0.0
