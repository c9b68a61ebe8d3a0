"""The default: points at fixed arc lengths, each followed by the bank of filters in `filters`.

"The closest waypoint of the frame before" slides along a rope that moves along itself. Here a point of the rope is
known by its arc length from the start, and where the visible part begins and ends on the rope is found by laying the
new curve on the predicted one: so neither a tip that jitters nor a part that is hidden passes for motion.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numba import njit
from numpy.typing import NDArray

from ropetrace.motion import filters
from ropetrace.motion.inextensible import make_inextensible
from ropetrace.types import FloatArray, Motion, Waypoints

SPACING = 1.25
"""Of the points that are followed, in diameters: two to a slice."""

MOST_POINTS = 200
"""A longer rope is followed at wider spacing."""

FEWEST_POINTS = 8
"""A shorter rope is followed more closely."""

FIRST_NOISE = 0.04
"""Standard deviation of the points that is assumed until it has been measured, in diameters."""

LENGTH_CHANGE = 1.5
"""A visible length that is off by less than this, in diameters, or by `LENGTH_SHARE`, has been measured differently; by
more, an end has been hidden or uncovered, and the other end is where it was."""

LENGTH_SHARE = 0.015
"""The same as a share of the length."""

LENGTH_MEMORY = 0.07
"""Time constant with which the visible length is learned, seconds. So an end that is hidden by less than
`LENGTH_CHANGE` in this time passes for one that moves, and no end does that moves faster."""

TIP_TRUST = 0.75
"""Share of the tips' shift along the rope that is taken for the rope's: the rest is jitter. If much less were taken,
the filters would lag behind their own predictions and swing ever further."""

LONGEST_PAUSE = 0.25
"""After a longer one nothing is left of the motion, seconds."""

MOST_MISSED = 2
"""Frames in a row that may be late or not fit what was expected; the next one is believed."""

VELOCITY_SMOOTHING, ACCELERATION_SMOOTHING = 300.0, 1e4
"""Of the fields along the rope, see `filters.smoothing_factor`: waves shorter than 16 and 29 points are noise."""


class ArcLengthMotion:
    """Follows one rope; see `motion.MotionEstimator`.

    Parameters
    ----------
    diameter : float
        Of the rope, metres: the scale of the slices and so of their noise.
    """

    def __init__(self, diameter: float) -> None:
        self._diameter = diameter
        self.reset()

    def reset(self) -> None:
        """Forget the frames so far."""
        self._stamp_ns: int | None = None
        self._missed = 0
        self._known_ns: int | None = None
        self._count = 0.0

    @property
    def stamp_ns(self) -> int | None:
        """Of the frame that `predict` starts from."""
        return self._known_ns

    def update(self, stamp_ns: int, waypoints: Waypoints) -> Motion | None:
        """Take the waypoints of a frame; see `motion.MotionEstimator.update`."""
        if not np.isfinite(waypoints.positions).all():
            raise ValueError("waypoints: a coordinate is not a finite number")
        if waypoints.length <= 0:
            return None
        dt = 0.0 if self._stamp_ns is None else (stamp_ns - self._stamp_ns) * 1e-9
        if self._stamp_ns is None or abs(dt) > LONGEST_PAUSE:
            self._start(stamp_ns, waypoints)
            return None
        if dt > 0:
            self._stamp_ns = stamp_ns
            self._unseen += dt
            filters.advance(self._states, self._spreads, dt)
            filters.mixture(self._states, self._spreads, self._noise, self._weights, self._means, self._covariances)
        if dt <= 0 or not self._lay_on(waypoints, dt):
            self._missed += 1
            if self._missed > MOST_MISSED:
                self._start(stamp_ns, waypoints)
            return None
        self._missed = 0
        self._count = filters.correct(
            self._states, self._spreads, self._evidence, self._surprise, self._count, self._points, self._measured
        )
        filters.weigh(self._evidence, self._surprise, self._count, self._noise, self._weights)
        filters.mixture(self._states, self._spreads, self._noise, self._weights, self._means, self._covariances)
        self._unseen[self._measured] = 0.0
        self._waypoints = waypoints
        self._known_ns = stamp_ns
        self._fit_grid()
        self._smooth_fields()
        return self._at_waypoints(0.0)[1]

    def predict(self, ahead: float) -> tuple[FloatArray, Motion] | None:
        """Where the waypoints of the last update are `ahead` seconds later; see `motion.MotionEstimator.predict`."""
        if self._known_ns is None:
            return None
        return self._at_waypoints(ahead)

    def _start(self, stamp_ns: int, waypoints: Waypoints) -> None:
        length = waypoints.length
        count = int(np.clip(round(length / (SPACING * self._diameter)) + 1, FEWEST_POINTS, MOST_POINTS))
        self._stamp_ns = stamp_ns
        self._known_ns = None
        self._missed = 0
        self._arcs = np.linspace(0.0, length, count)
        self._extent = (0.0, length)
        self._count = filters.PRIOR_COUNT
        self._allocate(count)
        _sample(waypoints.positions, waypoints.arc_length, self._arcs, self._points)
        variance = (FIRST_NOISE * self._diameter) ** 2
        self._states[:, :, 0] = self._points
        self._spreads[:] = _unknown(variance)
        self._evidence[:] = filters.PRIOR_COUNT * variance
        self._noise[:] = variance
        self._weights[:] = 1 / len(filters.AGILITIES)
        filters.mixture(self._states, self._spreads, self._noise, self._weights, self._means, self._covariances)

    def _allocate(self, count: int) -> None:
        models = len(filters.AGILITIES)
        self._states = np.zeros((models, count, 3, 3))
        self._spreads = np.zeros((models, count, 6))
        self._evidence = np.zeros((models, count, 3))
        self._surprise = np.zeros((models, count))
        self._noise = np.zeros((models, count, 3))
        self._weights = np.zeros((models, count))
        self._unseen = np.zeros(count)
        self._means = np.zeros((count, 3, 3))
        self._covariances = np.zeros((count, 3, 6))
        self._density = np.zeros((count, 3))
        self._points = np.zeros((count, 3))
        self._measured = np.ones(count, np.bool_)
        self._velocities = np.zeros((count, 3))
        self._accelerations = np.zeros((count, 3))
        self._velocity_factor = filters.smoothing_factor(count, VELOCITY_SMOOTHING)
        self._acceleration_factor = filters.smoothing_factor(count, ACCELERATION_SMOOTHING)

    def _lay_on(self, waypoints: Waypoints, dt: float) -> bool:
        """Find which arc length of the curve each followed point has, and its place; whether they fit."""
        span = self._arcs[-1] - self._arcs[0]
        start, end, fits = _lay_on(
            self._means[:, 0],
            self._arcs,
            *self._extent,
            waypoints.positions,
            waypoints.arc_length,
            max(LENGTH_CHANGE * self._diameter, LENGTH_SHARE * span),
            self._points,
            self._measured,
        )
        seen = np.count_nonzero(self._measured)
        lost = filters.outliers(
            self._means, self._covariances, self._points, self._unseen, self._diameter / 2, self._measured
        )
        if not fits or 3 * lost >= seen:
            return False
        if (start, end) == (self._arcs[0], self._arcs[-1]):
            growth = -np.expm1(-dt / LENGTH_MEMORY) * (waypoints.length / span - 1)
            self._arcs += growth * (self._arcs - start)
            end = self._arcs[-1]
        self._extent = (start, end)
        return True

    def _smooth_fields(self) -> None:
        self._velocities[:] = self._means[:, 1]
        self._accelerations[:] = self._means[:, 2]
        filters.smooth(self._velocity_factor, self._velocities)
        filters.smooth(self._acceleration_factor, self._accelerations)
        places = np.ascontiguousarray(self._means[:, 0])
        make_inextensible(places, self._velocities, self._accelerations, self._measured)
        filters.jerk_density(self._noise, self._weights, self._density)
        # The next frame may not fit: what is predicted until then rests on this one.
        self._settled = self._covariances.copy()

    def _at_waypoints(self, ahead: float) -> tuple[FloatArray, Motion]:
        waypoints = self._waypoints
        values = np.empty((len(waypoints), 6, 3))
        _at_waypoints(
            waypoints.positions,
            waypoints.arc_length,
            self._extent[0],
            self._extent[1],
            self._arcs,
            self._velocities,
            self._accelerations,
            self._settled,
            self._density,
            ahead,
            values,
        )
        return values[:, 0], Motion(values[:, 1], values[:, 2], values[:, 3], values[:, 4], values[:, 5])

    def _fit_grid(self) -> None:
        """Follow the visible part: drop what has been hidden for long, take what has come into view."""
        kept = self._arcs[self._unseen <= LONGEST_PAUSE]
        low, high = min(kept[0], self._extent[0]), max(kept[-1], self._extent[1])
        if (low, high) != (self._arcs[0], self._arcs[-1]):
            self._regrid(low, high)

    def _regrid(self, low: float, high: float) -> None:
        old = self._arcs, self._states, self._spreads, self._evidence, self._surprise, self._unseen
        arcs, states, spreads, evidence, surprise, unseen = old
        count = int(np.clip(round((high - low) / (SPACING * self._diameter)) + 1, FEWEST_POINTS, MOST_POINTS))
        self._arcs = np.linspace(low, high, count)
        self._allocate(count)
        place = np.interp(self._arcs, arcs, np.arange(len(arcs)))
        before = np.minimum(place.astype(int), len(arcs) - 2)
        part = place - before
        for values, target in ((states, self._states), (spreads, self._spreads), (evidence, self._evidence)):
            weight = part.reshape(-1, *[1] * (values.ndim - 2))
            target[:] = (1 - weight) * values[:, before] + weight * values[:, before + 1]
        self._surprise[:] = (1 - part) * surprise[:, before] + part * surprise[:, before + 1]
        self._unseen[:] = np.maximum(unseen[before], unseen[before + 1])
        # New points are where they are seen, and move as the nearest that is known, as far as anyone can tell.
        fresh = (self._arcs < arcs[0] - 1e-9) | (self._arcs > arcs[-1] + 1e-9)
        scale = self._waypoints.length / (self._extent[1] - self._extent[0])
        seen_at = (self._arcs - self._extent[0]) * scale
        _sample(self._waypoints.positions, self._waypoints.arc_length, seen_at, self._points)
        self._states[:, fresh, 0] = self._points[fresh]
        self._spreads[:, fresh] = _unknown((FIRST_NOISE * self._diameter) ** 2)
        filters.weigh(self._evidence, self._surprise, self._count, self._noise, self._weights)
        filters.mixture(self._states, self._spreads, self._noise, self._weights, self._means, self._covariances)


def _unknown(variance: float) -> NDArray[np.float64]:
    """The covariance of a point that is seen for the first time, in units of the measurement variance."""
    velocity, acceleration = filters.FIRST_VELOCITY**2 / variance, filters.FIRST_ACCELERATION**2 / variance
    return np.array([1.0, 0.0, 0.0, velocity, 0.0, acceleration])


@njit(cache=True, nogil=True)
def _place(positions: Any, arcs: Any, at: float, hint: int, out: Any) -> int:
    """The curve at an arc length, carried on straight beyond its ends; returns the segment, a hint for the next."""
    last = len(arcs) - 2
    segment = min(max(hint, 0), last)
    while segment > 0 and arcs[segment] > at:
        segment -= 1
    while segment < last and arcs[segment + 1] < at:
        segment += 1
    part = (at - arcs[segment]) / max(arcs[segment + 1] - arcs[segment], 1e-12)
    for c in range(3):
        out[c] = positions[segment, c] + part * (positions[segment + 1, c] - positions[segment, c])
    return segment


@njit(cache=True, nogil=True)
def _sample(positions: Any, arcs: Any, at: Any, out: Any) -> None:
    segment = 0
    for n in range(len(at)):
        segment = _place(positions, arcs, at[n], segment, out[n])


@njit(cache=True, nogil=True)
def _misfit(points: Any, arcs: Any, positions: Any, lengths: Any, offset: float, scale: float) -> float:
    """Mean squared distance of the points to the curve at ``offset + scale arc``, of those that are on it."""
    here = np.empty(3)
    total, count, segment = 0.0, 0, 0
    for n in range(len(points)):
        at = offset + scale * arcs[n]
        if not 0.0 <= at <= lengths[-1]:
            continue
        segment = _place(positions, lengths, at, segment, here)
        for c in range(3):
            total += (here[c] - points[n, c]) ** 2
        count += 1
    return total / count if count else np.inf


@njit(cache=True, nogil=True)
def _lay_on(
    means: Any,
    arcs: Any,
    first: float,
    last: float,
    positions: Any,
    lengths: Any,
    tolerance: float,
    points: Any,
    measured: Any,
) -> tuple[float, float, bool]:
    """Lay the new curve on the predicted points.

    Parameters
    ----------
    means : (N, 3) predicted points; arcs (N,) their arc lengths.
    first, last : arc lengths at which the visible part began and ended so far.
    positions (W, 3), lengths (W,) : the new curve.
    tolerance : metres, see `LENGTH_CHANGE`.
    points (N, 3), measured (N,) : what is found.

    Returns
    -------
    The new first and last, and whether the curve fits: not if it runs the other way.
    """
    count, length = len(arcs), lengths[-1]
    scale, offset, least = 1.0, -first, np.inf
    for candidate in (-first, length - last):
        misfit = _misfit(means, arcs, positions, lengths, candidate, 1.0)
        if misfit < least:
            least, offset = misfit, candidate
    if least > tolerance * tolerance:
        for candidate in (last, length + first):
            if _misfit(means, arcs, positions, lengths, candidate, -1.0) < 0.25 * least:
                return first, last, False

    tangent, here = np.empty(3), np.empty(3)
    for _ in range(2):
        # Slide and stretch along the rope so that what is left is across it.
        s0 = s1 = s2 = r0 = r1 = 0.0
        segment = 0
        for n in range(count):
            at = offset + scale * arcs[n]
            if at < -tolerance or at > length + tolerance:
                continue
            segment = _place(positions, lengths, at, segment, here)
            before, after = max(n - 1, 0), min(n + 1, count - 1)
            size = along = 0.0
            for c in range(3):
                tangent[c] = means[after, c] - means[before, c]
                size += tangent[c] ** 2
            for c in range(3):
                along += (means[n, c] - here[c]) * tangent[c]
            along /= np.sqrt(max(size, 1e-18))
            u = arcs[n]
            s0 += 1.0
            s1 += u
            s2 += u * u
            r0 += along
            r1 += along * u
        across = s0 * s2 - s1 * s1
        if across <= 1e-12 * s2 * s0:
            return first, last, False
        offset += (s2 * r0 - s1 * r1) / across
        scale += (s0 * r1 - s1 * r0) / across

    # The tips tell where the ends are: both if the length is what it was, else the one that has not moved.
    span = arcs[-1] - arcs[0]
    keeps_start = abs(offset + scale * first) < abs(offset + scale * last - length)
    whole = 1.0 / (1.0 + ((length - span) / tolerance) ** 6)
    tip_scale = whole * length / span + 1.0 - whole
    tip_offset = -whole * arcs[0] * length / span + (1.0 - whole) * (-first if keeps_start else length - last)
    offset += TIP_TRUST * (tip_offset - offset)
    scale += TIP_TRUST * (tip_scale - scale)

    start, end = -offset / scale, (length - offset) / scale
    if whole > 0.5:
        start, end = arcs[0], arcs[-1]
    elif keeps_start:
        start = first
    else:
        end = last
    segment = 0
    for n in range(count):
        measured[n] = start - 1e-9 <= arcs[n] <= end + 1e-9
        segment = _place(positions, lengths, offset + scale * arcs[n], segment, points[n])
    return start, end, True


@njit(cache=True, nogil=True)
def _at_waypoints(
    positions: Any,
    lengths: Any,
    first: float,
    last: float,
    arcs: Any,
    velocities: Any,
    accelerations: Any,
    covariances: Any,
    density: Any,
    ahead: float,
    out: Any,
) -> None:
    """Position, velocity, acceleration and their standard deviations at the waypoints, (W, 6, 3).

    A waypoint is where it was seen and then moves as the points beside it.
    """
    count = len(arcs)
    f01, f02, f12, f22 = filters.transition(ahead)
    fields = np.empty((count, 6, 3))
    for n in range(count):
        for c in range(3):
            p = covariances[n, c]
            q = density[n, c]
            v, a = velocities[n, c], accelerations[n, c]
            fields[n, 0, c] = f01 * v + f02 * a
            fields[n, 1, c] = v + f12 * a
            fields[n, 2, c] = f22 * a
            pp = p[0] + 2 * f01 * p[1] + 2 * f02 * p[2]
            pp += f01 * f01 * p[3] + 2 * f01 * f02 * p[4] + f02 * f02 * p[5] + q * ahead**5 / 20
            vv = p[3] + 2 * f12 * p[4] + f12 * f12 * p[5] + q * ahead**3 / 3
            fields[n, 3, c] = np.sqrt(max(pp, 0.0))
            fields[n, 4, c] = np.sqrt(max(vv, 0.0))
            fields[n, 5, c] = np.sqrt(max(f22 * f22 * p[5] + q * ahead, 0.0))
    scale = (last - first) / lengths[-1]
    spacing = (arcs[-1] - arcs[0]) / (count - 1)
    for i in range(len(positions)):
        place = (first + scale * lengths[i] - arcs[0]) / spacing
        n = min(max(int(place), 0), count - 2)
        part = min(max(place - n, 0.0), 1.0)
        for d in range(6):
            for c in range(3):
                out[i, d, c] = (1 - part) * fields[n, d, c] + part * fields[n + 1, d, c]
        for c in range(3):
            out[i, 0, c] += positions[i, c]
