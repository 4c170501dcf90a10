"""How light crosses a scene: straight flights, grain events, boundaries and surfaces, at every level of detail.

A walker is one sample of one pixel, followed backwards from the camera. All levels share its states: it flies straight,
it jumps from where light enters a grain's bounding sphere to where it leaves it, or it is in a grain of the explicit
level. Deep inside a medium, farther from everything than the next event can take it, it takes step after step without
the ray engine. A shadow is a walker that flies toward a light and loses weight or ends on its way.

The rules at boundaries are those of Meng et al. 2015 (supplemental): a jump that meets a surface ends there, as an
ordinary surface vertex; one that leaves the medium ends on its boundary, which is index-matched. No point is ever moved
but along a segment that is known to be free, so light cannot leak through a surface. Absorption is kept as amounts of
matter crossed and becomes colour when light is found, for all wavelengths at once.
"""

import math
from typing import NamedTuple

from tsdf import explicit as X
from tsdf import memory as M
from tsdf.compiled import njit
from tsdf.geometry import MESH, NONE, ball_hit, clearance, exact_hit, facet_hit
from tsdf.lights import draw as draw_light
from tsdf.lights import radiance as light_from
from tsdf.sampler import column_of, density, draw_column, draw_length, draw_offset, draw_record, leave, turned
from tsdf.sampling import GOLDEN, key_of, mix, unit
from tsdf.vectors import KERNEL, cross, dot, frame, minus, step, triple
from tsdf.walker import (
    ASKED,
    DIM,
    EVENTS,
    EXPLICIT,
    FAINT,
    FAULTS,
    FLY,
    GRAIN,
    GRAINS_ASKED,
    GRAZING,
    JUMP,
    LIVE,
    OTHER,
    PATIENCE,
    RAYS,
    TELEPORT,
    TELEPORT_JOINT,
    TELEPORT_MEMORY,
    TRIES,
    TRUNCATED,
    UNKNOWN,
    VOLUME,
    VOLUME_HG,
    cast,
    copy,
    find,
    halves,
    lives,
    renewed,
    write,
)  # fmt: skip


class Camera(NamedTuple):
    """Rays of a picture: along corner + x right + y down from origin + x aside + y below, x in [0, width), y in
    [0, height). A pinhole moves no origins, a parallel beam turns no directions."""

    origin: tuple[float, float, float]
    aside: tuple[float, float, float]
    below: tuple[float, float, float]
    corner: tuple[float, float, float]
    right: tuple[float, float, float]
    down: tuple[float, float, float]
    width: int


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
def offset_of(media, tables, c, column, key):
    """Draw r, z, phi_Delta and the path length [R] given the deflection, from the word of `key` and the next."""
    bits = mix(key)
    if media.model == TELEPORT_JOINT:
        return draw_record(tables, column, unit(bits))
    u2, u3 = halves(bits)
    u4, u5 = halves(mix(key + GOLDEN))
    r, z, phi = draw_offset(tables, column, u2, u3, u4)
    return r, z, phi, draw_length(tables, column, u5) if media.slot[c] >= 0 else 0.0


# ------------------------------------------------------------------------------------- next-event estimation


@njit(**KERNEL)
def connect(w, amounts, m, p, d, c, key, share, bound, media, tables, lights, shadow, its_amounts):
    """Start in `shadow` light that arrives from a light and is deflected into the walker's path by a grain; return
    whether there is any.

    The grain, of component c in medium m, is entered at p by a walker along d. `share` is the probability that this is
    done at all; nothing is nearer than `bound`.
    """
    key = mix(key ^ OTHER)
    u0, u1 = halves(key)
    key += GOLDEN
    bits = mix(key)
    toward, light_pdf, light = draw_light(lights, u0, u1, unit(bits))
    if not light_pdf > 0.0:
        return False
    cosine = dot(d, toward)
    column = 0
    if media.model <= VOLUME:
        column = column_of(tables, c, min(max(cosine, -1.0), 1.0))
        phase = density(tables, column)
    elif media.model == VOLUME_HG:
        phase = lobe_density(media.g[c], cosine)
    else:
        phase = 0.25 / math.pi
    if not phase > 0.0:
        return False
    weight = phase / (light_pdf + phase) / share
    copy(its_amounts, amounts)
    amount, offset = 1.0, (0.0, 0.0, 0.0)
    key += GOLDEN
    if media.model <= TELEPORT_JOINT:
        r, z, phi, length = offset_of(media, tables, c, column, key)
        key += GOLDEN
        side = step(toward, -cosine, d)
        size = math.sqrt(dot(side, side))
        if size > 1e-12:
            side = (side[0] / size, side[1] / size, side[2] / size)
        else:
            side = frame(d)[0]
        co, si = turned(phi * (0.5 / math.pi) - math.floor(phi * (0.5 / math.pi)))
        scale = media.scale[c]
        amount = scale * length
        along, aside, up = z * scale, r * co * scale, r * si * scale
        offset = step(step((along * d[0], along * d[1], along * d[2]), aside, side), up, cross(d, side))
    elif media.model == VOLUME:
        amount = media.scale[c] * draw_length(tables, column, unit(mix(key))) if media.slot[c] >= 0 else 0.0
    if media.slot[c] >= 0:
        its_amounts[media.slot[c]] += amount
    cast(w, shadow, p, toward, light, weight, m, key)
    size = math.sqrt(dot(offset, offset))
    if size > 0.0:
        if size < bound:
            write(shadow.p, step(p, 1.0, offset))
        else:
            aim(shadow, offset, size, toward, amount, c)
    return True


@njit(**KERNEL)
def aim(w, offset, size, d_out, amount, c):
    """Begin a jump of given size along an offset of any length."""
    w.mode, w.length, w.gained, w.component = JUMP, size, amount, c
    norm = 1.0 / math.sqrt(dot(offset, offset))
    write(w.e, (offset[0] * norm, offset[1] * norm, offset[2] * norm))
    write(w.q, d_out)


# ------------------------------------------------------------------------------------------ deep inside


@njit(**KERNEL)
def wander(w, amounts, once, out, out_amounts, live, most, g, media, tables, lights, absorption, counters):
    """Take a walker that is in a known medium from event to event while nothing else can be met.

    With `once` it is known that the walker reaches the end of its free path: one event. A jump that may meet something
    is left to `land`. The draws are written out here: a kernel that takes `tables` and is called once per event takes
    twice the time.

    Returns
    -------
    live : int
        Walkers in `out`, shadows included.
    state : int
        0: the walker must look where it goes, 1: it must wait for its next turn, 2: it has ended.
    """
    m = w.medium
    p, d, key, free = triple(w.p), triple(w.d), w.key, w.free
    model, mean, reach, travel, sampled = media.model, media.free[m], media.reach[m], media.travel[m], lights.sampled
    first, last = media.first[m], media.first[m] + media.kinds[m] - 1
    luck, pdf, steps, state = w.luck, w.pdf, 0, 0
    patience = min(PATIENCE, media.limit - w.events)
    bound, fresh = clearance(g, m, p), True
    while True:
        if free < 0.0:
            key += GOLDEN
            free = -mean * math.log(1.0 - unit(mix(key)))
        if not once and bound <= free:
            if not fresh:
                bound = clearance(g, m, p)
            if bound <= free:
                break
        if steps >= patience or live >= most:
            state = 1
            break
        fresh = False
        steps += 1
        p = step(p, free, d)
        bound -= free
        if travel >= 0:
            amounts[travel] += free
            luck += absorption.least[travel] * free
        free = -1.0

        c = first
        if last > first:
            key += GOLDEN
            u = unit(mix(key))
            while c < last and u >= media.choice[c]:
                c += 1
        slot, scale = media.slot[c], media.scale[c]
        if sampled:
            if bound < 8.0 * mean:
                bound = max(bound, clearance(g, m, p))
            share = min(1.0, math.exp((reach - bound) / mean))
            key += GOLDEN
            if unit(mix(key)) < share:
                live += connect(w, amounts, m, p, d, c, key, share, bound, media, tables, lights,
                                out[live], out_amounts[live])  # fmt: skip

        key += GOLDEN
        u0, u1 = halves(mix(key))
        r, z, phi, length = 0.0, 0.0, 0.0, 1.0
        if model <= VOLUME:
            column, cosine = draw_column(tables, c, u0)
            pdf = density(tables, column)
            if pdf <= 0.0:
                pdf = -1.0
            key += GOLDEN
            bits = mix(key)
            if model == TELEPORT_JOINT:
                r, z, phi, length = draw_record(tables, column, unit(bits))
            elif model == TELEPORT:
                u2, u3 = halves(bits)
                key += GOLDEN
                u4, u5 = halves(mix(key))
                r, z, phi = draw_offset(tables, column, u2, u3, u4)
                if slot >= 0:
                    length = draw_length(tables, column, u5)
            elif slot >= 0:
                length = draw_length(tables, column, unit(bits))
        elif model == VOLUME_HG:
            cosine = lobe(media.g[c], u0)
            pdf = lobe_density(media.g[c], cosine)
        else:
            cosine, pdf = 1.0 - 2.0 * u0, 0.25 / math.pi
        d, offset = leave(d, cosine, u1, r, z, phi)
        d = renewed(d)
        if slot >= 0:
            length *= scale
            amounts[slot] += length
            luck += absorption.least[slot] * length
        if reach > 0.0:
            size = scale * math.sqrt(dot(offset, offset))
            if bound <= size:
                bound = clearance(g, m, p)
            if bound <= size and size > 0.0:
                aim(w, offset, size, d, length, c)
                once = True
            else:
                p = step(p, scale, offset)
                bound -= size
        if luck < DIM:
            w.luck = luck
            key += GOLDEN
            if not lives(w, key):
                state = 2
                break
            luck = w.luck
        if once:
            break
    counters[EVENTS] += steps
    w.events += steps
    write(w.p, p)
    write(w.d, d)
    w.key, w.free, w.luck, w.pdf = key, free, luck, pdf
    if state != 2 and w.events >= media.limit:
        counters[TRUNCATED] += 1
        state = 2
    return live, state


# ---------------------------------------------------------------------------------------- where things are


@njit(**KERNEL)
def surface_met(g, p, d, hits, ray):
    """Return distance to the next opaque surface, its number, its normal against d, its thickness, and whether the ray
    engine named a facet that is behind p."""
    best, which, n, slack, spurious = math.inf, NONE, (0.0, 0.0, 0.0), 0.0, False
    if g.solid and hits[0, ray] >= 0:
        facet = hits[0, ray]
        t, cosine = facet_hit(g.planes, facet, p, d)
        slack = g.plane_slack[facet]
        if t < 0.0:
            spurious = True
        elif t < math.inf:
            best, which, n = t, g.surface[facet], (g.planes[facet, 0], g.planes[facet, 1], g.planes[facet, 2])
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
    return best, which, n, slack, spurious


@njit(**KERNEL)
def boundary_met(g, m, p, d, hits, ray):
    """Return distance to the next boundary of medium m, whether the ray is inside until then, the outward normal, the
    boundary's thickness, and whether the ray engine named a facet that is behind p."""
    if g.kind[m] != MESH:
        t, inside, n = exact_hit(g.kind[m], g.shape[m], p, d)
        return t, inside, n, g.slack[m], False
    facet = hits[g.engine[m], ray]
    if facet < 0:
        return math.inf, False, (0.0, 0.0, 0.0), 0.0, False
    t, cosine = facet_hit(g.planes, facet, p, d)
    n = (g.planes[facet, 0], g.planes[facet, 1], g.planes[facet, 2])
    return t, cosine > 0.0, n, g.plane_slack[facet], t < 0.0


@njit(**KERNEL)
def beyond(slack, cosine):
    """Return how far along a ray a point is to be moved to be clear of a facet."""
    return slack * min(1.0 / abs(cosine), GRAZING)


# ------------------------------------------------------------------------------------------- one walker

GO_ON, LOOK_AGAIN, ENDED = 0, 1, 2


@njit(**KERNEL)
def bounce(w, amounts, p, d, t, n, slack, surface, out, out_amounts, live, g, lights):
    """Put a walker that comes from p along d on a diffuse surface at distance t and send it on; return walkers in `out`
    and what becomes of it."""
    p = step(p, max(t - beyond(slack, dot(n, d)), 0.5 * t), d)
    before = max(w.colour[0], w.colour[1], w.colour[2])
    for k in range(3):
        w.colour[k] *= g.reflectance[surface, k]
    after = max(w.colour[0], w.colour[1], w.colour[2])
    if after <= 0.0:
        w.weight = 0.0
        return live, ENDED
    w.events += 1
    w.key += GOLDEN
    u0, u1 = halves(mix(w.key))
    if lights.sampled:
        w.key += GOLDEN
        u2, u3 = halves(mix(w.key))
        w.key += GOLDEN
        toward, light_pdf, light = draw_light(lights, u2, u3, unit(mix(w.key)))
        cosine = dot(n, toward)
        if light_pdf > 0.0 and cosine > 0.0:
            scattered = cosine / math.pi
            copy(out_amounts[live], amounts)
            cast(w, out[live], p, toward, light, scattered / (light_pdf + scattered), UNKNOWN, mix(w.key ^ OTHER))
            live += 1
    cosine = math.sqrt(1.0 - u0)
    d = bent(n, cosine, u1)
    write(w.p, p)
    write(w.d, renewed(d))
    w.mode, w.medium, w.free, w.skip, w.pdf = FLY, UNKNOWN, -1.0, 0.0, cosine / math.pi
    w.luck += math.log(after / before)
    if w.luck < DIM:
        w.key += GOLDEN
        if not lives(w, w.key):
            return live, ENDED
    return live, GO_ON


@njit(**KERNEL)
def again(w, slack, counters):
    """Move the start of a walker's next ray beyond a facet that the ray engine sees and that is behind it."""
    w.skip = max(2.0 * w.skip, slack)
    w.tries += 1
    if w.tries > TRIES:
        counters[FAULTS] += 1
        w.weight = 0.0
        return ENDED
    return LOOK_AGAIN


@njit(**KERNEL)
def land(w, amounts, hits, out, out_amounts, live, g, media, lights, counters):
    """End a walker's jump; return walkers in `out` and what becomes of it."""
    p, e, m = triple(w.p), triple(w.e), w.medium
    t, surface, n, slack, spurious = surface_met(g, p, e, hits, w.ray)
    if spurious:
        return live, again(w, slack, counters)
    t_b, inside, n_b, slack_b, spurious = boundary_met(g, m, p, e, hits, w.ray)
    if spurious:
        return live, again(w, slack_b, counters)
    w.skip, w.tries = 0.0, 0
    if not inside:  # by rounding: the jump begins on the boundary
        t_b = 0.0
    leaves = t_b < w.length
    end = min(w.length, t_b)
    if t < math.inf and (t - end) * abs(dot(n, e)) <= slack:
        if w.shadow:
            return live, ENDED
        if media.slot[w.component] >= 0:
            amounts[media.slot[w.component]] -= w.gained * max(0.0, 1.0 - t / w.length)
        return bounce(w, amounts, p, e, t, n, slack, surface, out, out_amounts, live, g, lights)
    move = min(beyond(slack_b, dot(n_b, e)), 0.5 * (t - t_b)) if inside else 0.0
    if leaves:
        for k in range(g.kind.shape[0]):
            t_k, inside, n_k, slack_k, spurious = boundary_met(g, k, p, e, hits, w.ray)
            if k != m and not inside and not spurious and abs(t_k - t_b) * abs(dot(n_k, e)) <= slack_b + slack_k:
                # Another medium begins where this one ends: the grain lies in both
                gone = min(t_b + move, w.length)
                write(w.p, step(p, gone, e))
                w.gained *= 1.0 - gone / w.length
                w.medium, w.length = k, w.length - gone
                return live, GO_ON
    write(w.d, triple(w.q))
    w.mode, w.free = FLY, -1.0
    if leaves:
        if media.slot[w.component] >= 0:
            amounts[media.slot[w.component]] -= w.gained * (1.0 - t_b / w.length)
        if dot(triple(w.q), n_b) < 0.0:
            move = -min(move, 0.5 * t_b)
        write(w.p, step(p, t_b + move, e))
        w.medium = UNKNOWN
    else:
        write(w.p, step(p, w.length, e))
    return live, GO_ON


@njit(**KERNEL)
def fly(w, amounts, hits, out, out_amounts, live, g, room, media, tables, lights, grains, memory, absorption, radiance,
        counters):  # fmt: skip
    """Take a walker along its straight flight to what comes first; return walkers in `out` and what becomes of it."""
    p, d = triple(w.p), triple(w.d)
    t, surface, n, slack, spurious = surface_met(g, p, d, hits, w.ray)
    if spurious:
        return live, again(w, slack, counters)
    home, t_b, n_b, slack_b = NONE, math.inf, n, 0.0
    for m in range(g.kind.shape[0]):
        t_m, inside, n_m, slack_m, spurious = boundary_met(g, m, p, d, hits, w.ray)
        if spurious:
            return live, again(w, slack_m, counters)
        if home == NONE and (inside or t_m < t_b):
            t_b, n_b, slack_b = t_m, n_m, slack_m
            if inside:
                home = m
    if home != w.medium:
        w.free = -1.0
    w.skip, w.tries, w.medium = 0.0, 0, home
    facing = abs(dot(n, d)) if t < math.inf else 1.0
    end = min(t, t_b)
    if home != NONE:
        if media.model == EXPLICIT:
            if w.shadow:
                return live, ENDED
            w.pdf = -1.0
            s, centre, key = X.next_grain(grains, room, home, p, d, end)
            if s < math.inf and (t - s) * facing > slack:
                enter(w, grains, media, home, s, centre, key)
                return live, GO_ON
        elif media.model == TELEPORT_MEMORY:
            if w.free < 0.0:
                M.begin(w, memory)
            if w.free < t_b and (t - w.free) * facing > slack:
                live, state = M.roam(w, amounts, True, out, out_amounts, live, live + 2, g, room, media, memory, tables,
                                     lights, absorption, counters)  # fmt: skip
                return live, ENDED if state == 2 else GO_ON
        elif w.shadow:
            w.weight *= math.exp(-end / media.free[home])
            if media.travel[home] >= 0:
                amounts[media.travel[home]] += end
            if w.weight < FAINT:
                w.key += GOLDEN
                if unit(mix(w.key)) * FAINT >= w.weight:
                    return live, ENDED
                w.weight = FAINT
        else:
            if w.free < 0.0:
                w.key += GOLDEN
                w.free = -media.free[home] * math.log(1.0 - unit(mix(w.key)))
            if w.free < t_b and (t - w.free) * facing > slack:
                live, state = wander(
                    w, amounts, True, out, out_amounts, live, live + 2, g, media, tables, lights, absorption, counters
                )
                return live, ENDED if state == 2 else GO_ON
            if media.travel[home] >= 0:
                amounts[media.travel[home]] += end
                w.luck += absorption.least[media.travel[home]] * end
    w.free = -1.0
    if t < math.inf and (t - t_b) * facing <= slack:
        if w.shadow:
            return live, ENDED
        return bounce(w, amounts, p, d, t, n, slack, surface, out, out_amounts, live, g, lights)
    if t_b < math.inf:
        write(w.p, step(p, t_b + min(beyond(slack_b, dot(n_b, d)), 0.5 * (t - t_b)), d))
        w.medium = UNKNOWN
        w.events += 1
        if w.events >= media.limit:
            counters[TRUNCATED] += 1
            return live, ENDED
        return live, GO_ON
    if w.shadow:
        find(w, 1.0, 1.0, 1.0, amounts, absorption, radiance)
    else:
        r, gr, b = light_from(lights, d, w.pdf)
        find(w, r, gr, b, amounts, absorption, radiance)
    return live, ENDED


@njit(**KERNEL)
def enter(w, grains, media, m, s, centre, key):
    """Bring a walker to a grain's bounding sphere at distance s and into the grain's frame."""
    radius = grains.radius[m]
    x = step(step(triple(w.p), s, triple(w.d)), -1.0, centre)
    x = (x[0] / radius, x[1] / radius, x[2] / radius)
    size = 1.0 / math.sqrt(dot(x, x))
    p = X.turned(key, (x[0] * size, x[1] * size, x[2] * size), True)
    write(w.p, p)
    write(w.e, p)
    write(w.d, X.turned(key, triple(w.d), True))
    write(w.q, centre)
    w.grain, w.mode, w.medium, w.state, w.facet, w.pdf = key, GRAIN, m, X.ENTERED, NONE, -1.0
    w.component = X.component_of(grains, media.first[m], media.kinds[m], key)
    w.ray = NONE


@njit(**KERNEL)
def in_grain(w, amounts, facet, grains, media, absorption, counters):
    """Take a walker through the next hit in its grain; return what becomes of it."""
    c, radius = w.component, grains.radius[w.medium]
    p, d = triple(w.p), triple(w.d)
    met = w.facet >= 0 or facet >= 0
    if grains.exemplar[c] == X.EXACT_SPHERE:
        p, d, length, w.key = X.through_sphere(p, d, grains.eta[c], grains.kept_apart[c], w.key)
        state = X.LEFT
    else:
        start, d, length, w.facet, state, w.key, fault = X.at_facet(
            grains.planes, grains.centroids, facet, w.facet, p, d, grains.eta[c], w.state, w.key
        )
        write(w.e, start)
        if state & X.RETRIED == 0:
            p = start
        if fault:
            counters[FAULTS] += 1
    if media.slot[c] >= 0 and length > 0.0:
        amounts[media.slot[c]] += media.scale[c] * length
        w.luck += absorption.least[media.slot[c]] * media.scale[c] * length
    w.state, w.ray = state, NONE
    if state & X.LEFT:
        if met or grains.exemplar[c] == X.EXACT_SPHERE:
            counters[EVENTS] += 1
            w.events += 1
        p = step(p, X.rim_of(p, d), d)
        out = X.turned(w.grain, p, False)
        write(w.p, step(triple(w.q), radius, out))
        write(w.d, renewed(X.turned(w.grain, d, False)))
        w.mode, w.free = FLY, -1.0
        if w.events >= media.limit:
            counters[TRUNCATED] += 1
            return ENDED
        if w.luck < DIM:
            w.key += GOLDEN
            if not lives(w, w.key):
                return ENDED
    else:
        write(w.p, p)
        write(w.d, d)
    return GO_ON


@njit(**KERNEL)
def advance(count, walkers, amounts, out, out_amounts, hits, grain_hits, starts, ways, grain_starts, grain_ways,
            g, room, media, tables, lights, grains, memory, absorption, radiance, counters, asked):  # fmt: skip
    """Take each walker as far as it comes without the ray engine.

    What goes on is written to out and out_amounts, the rays it needs to starts and ways (n, 3) float32, and for the
    exemplars to grain_starts and grain_ways (e, n, 3). What has ended stays in `walkers`, the number of its sample
    inverted (~sample); but for shadows, its weight is 0 unless it left the scene or reached the limit of events.
    `asked` (2 + e,) int64 receives the numbers of walkers, of rays and of rays by exemplar.
    """
    live, rays = 0, 0
    for i in range(asked.shape[0]):
        asked[i] = 0
    explicit, remembers = media.model == EXPLICIT, media.model == TELEPORT_MEMORY
    for i in range(count):
        w, a = walkers[i], amounts[i]
        most = out.shape[0] - (count - i) - 2
        turns = 0
        while True:
            if w.mode == GRAIN:
                e = grains.exemplar[w.component]
                if w.ray < 0 and e != X.EXACT_SPHERE:
                    w.ray = asked[GRAINS_ASKED + e]
                    for k in range(3):
                        grain_starts[e, w.ray, k], grain_ways[e, w.ray, k] = w.e[k], w.d[k]
                    asked[GRAINS_ASKED + e] += 1
                    break
                facet = NONE if e == X.EXACT_SPHERE else grain_hits[e, w.ray]
                status = in_grain(w, a, facet, grains, media, absorption, counters)
                if status == ENDED:
                    w.sample = ~w.sample
                    break
                continue
            if w.mode == FLY and w.ray < 0 and w.medium >= 0 and (remembers or not w.shadow):
                if explicit:
                    bound = clearance(g, w.medium, triple(w.p))
                    if bound > 0.0:
                        s, centre, key = X.next_grain(grains, room, w.medium, triple(w.p), triple(w.d), bound)
                        if s < math.inf:
                            enter(w, grains, media, w.medium, s, centre, key)
                            turns += 1
                            if turns > PATIENCE:
                                break
                            continue
                elif w.skip == 0.0:
                    if remembers:
                        live, state = M.roam(w, a, False, out, out_amounts, live, most, g, room, media, memory, tables,
                                             lights, absorption, counters)  # fmt: skip
                    else:
                        live, state = wander(
                            w, a, False, out, out_amounts, live, most, g, media, tables, lights, absorption, counters
                        )
                    if state == 2:
                        w.sample = ~w.sample
                        break
                    if state == 1:
                        break
            turns += 1
            if (g.engines > 0 and w.ray < 0) or (live >= most and not w.shadow) or turns > PATIENCE:
                if g.engines > 0:
                    way = triple(w.e) if w.mode == JUMP else triple(w.d)
                    start = step(triple(w.p), w.skip, way)
                    w.ray = rays
                    write(starts[rays], start)
                    write(ways[rays], way)
                    rays += 1
                break
            if w.mode == JUMP:
                live, status = land(w, a, hits, out, out_amounts, live, g, media, lights, counters)
            else:
                live, status = fly(w, a, hits, out, out_amounts, live, g, room, media, tables, lights, grains, memory,
                                   absorption, radiance, counters)  # fmt: skip
            w.ray = NONE
            if status == ENDED:
                w.sample = ~w.sample
                break
        if w.sample >= 0:
            out[live] = w
            copy(out_amounts[live], a)
            live += 1
    # Shadows that were born on the way have not looked yet
    if g.engines > 0:
        for i in range(live):
            w = out[i]
            if w.ray < 0 and w.mode != GRAIN:
                way = triple(w.e) if w.mode == JUMP else triple(w.d)
                w.ray = rays
                write(starts[rays], step(triple(w.p), w.skip, way))
                write(ways[rays], way)
                rays += 1
    counters[RAYS] += rays
    asked[LIVE], asked[ASKED] = live, rays


@njit(**KERNEL)
def spawn(first, count, pixels, spp, sample, seed, camera, walkers, amounts):
    """Start walkers for the samples first .. first + count - 1 of a job: sample i is of pixel pixels[0] + i // spp."""
    for i in range(count):
        local = first + i
        pixel = pixels + local // spp
        w = walkers[i]
        key = key_of(seed, pixel, sample + local % spp)
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
        w.tries, w.shadow = 0, 0
        for k in range(amounts.shape[1]):
            amounts[i, k] = 0.0
