// Limits on a window of targets; see `dual_ur10.sim2real.control.limits.Envelope`, which computes all coefficients.
#pragma once

#include "fields.hpp"
#include "numbers.hpp"

constexpr int64_t HISTORY = 3;

#define ENVELOPE(INT, REAL, INTS, REALS, LINK, FUNCTION)                                                               \
    INT(ticks) INT(width) INT(m) INT(speed_rows) INT(position_row) INT(samples) INT(stops) REAL(tick_s)                \
    REAL(tcp_speed_m_s) REAL(rest_speed_rad_s) REAL(peak_between) REALS(rows, m * width) INTS(begins, m) INTS(ends, m) \
    REALS(middle, m * 12) REALS(scale, m * 12) REALS(lever, 24) REALS(reach_m, 12) REALS(brake_samples, samples * 6)   \
    INTS(stop, stops) REALS(brake, ticks * 3) REALS(coast, ticks * 3) REALS(lengths_m, 12) REALS(tcp_m, 6)

STRUCTURE(Envelope, ENVELOPE)

// Limited quantities of a window (width, 12) as signed fractions of their limits. Differences are taken relative to the
// last past target: their terms are small then, and so is their rounding.
struct Quantities {
    const Envelope& envelope;
    const double* last;
    double* relative;  // (width, 12)

    Quantities(const Envelope& e, const double* window, double* scratch)
        : envelope(e), last(window + (HISTORY - 1) * JOINTS), relative(scratch) {
        for (int64_t k = 0; k < e.width; ++k)
            for (int64_t j = 0; j < JOINTS; ++j) relative[k * JOINTS + j] = window[k * JOINTS + j] - last[j];
    }

    // The quantity itself, (12,).
    void value(int64_t row, double* out) const {
        weighted(envelope.rows + row * envelope.width, envelope.begins[row], envelope.ends[row], relative, out);
        if (row >= envelope.position_row)
            for (int64_t j = 0; j < JOINTS; ++j) out[j] += last[j];
    }

    void fraction(int64_t row, double* out) const {
        value(row, out);
        const double *middle = envelope.middle + row * JOINTS, *scale = envelope.scale + row * JOINTS;
        for (int64_t j = 0; j < JOINTS; ++j) out[j] = (out[j] - middle[j]) * scale[j];
    }
};

// True if no fraction in (12,) is above `full` in size; false for NaN.
static inline bool all_within(const double* fraction, double full) {
    bool within = true;
    for (int64_t j = 0; j < JOINTS; ++j) within &= fabs(fraction[j]) <= full;
    return within;
}

static inline void raise_peak(double* peak, const double* fraction) {
    for (int64_t j = 0; j < JOINTS; ++j) peak[j] = larger(peak[j], fabs(fraction[j]));
}

// Upper bound of the used fraction of the Cartesian speed limit, from the peaks of the joint speeds alone.
static inline double cartesian_bound(const Envelope& e, const double* peak) {
    double bound[2] = {};
    for (int64_t j = 0; j < JOINTS; ++j)
        for (int64_t arm = 0; arm < 2; ++arm) bound[arm] += peak[j] * e.lever[2 * j + arm];
    return larger_or_nan(bound[0], bound[1]);
}

struct Points {
    Vector elbow, flange, tcp;
};

// Elbow, flange and tool centre point in `base`, by the geometry common to all UR arms: joints 2, 3 and 4 are parallel,
// so all lies in a plane that the first joint rotates, but for the distance beside it.
static inline Points points_of_arm(const double* lengths, const double* tcp, const double* q) {
    const double d1 = lengths[0], a2 = lengths[1], a3 = lengths[2], d4 = lengths[3], d5 = lengths[4], d6 = lengths[5];
    const SineCosine t1 = sine_cosine(q[0]), t2 = sine_cosine(q[1]), t23 = sine_cosine(q[1] + q[2]);
    const SineCosine t234 = sine_cosine(q[1] + q[2] + q[3]), t5 = sine_cosine(q[4]);
    const auto place = [&](double out, double beside, double up) {
        return Vector{out * t1.cosine + beside * t1.sine, out * t1.sine - beside * t1.cosine, up};
    };
    const double out = a2 * t2.cosine, up = d1 + a2 * t2.sine;
    const double along = t234.cosine * t5.sine, high = t234.sine * t5.sine;
    Points points;
    points.elbow = place(out, 0.0, up);
    points.flange = place(out + a3 * t23.cosine + d5 * t234.sine - d6 * along, d4 + d6 * t5.cosine,
                          up + a3 * t23.sine - d5 * t234.cosine - d6 * high);
    points.tcp = points.flange;
    if (tcp[0] != 0.0 || tcp[1] != 0.0 || tcp[2] != 0.0) {
        const SineCosine t6 = sine_cosine(q[5]);
        const double c5 = t5.cosine, s5 = t5.sine, c6 = t6.cosine, s6 = t6.sine, c = t234.cosine, s = t234.sine;
        const Vector x = place(c * c5 * c6 - s * s6, s5 * c6, s * c5 * c6 + c * s6);
        const Vector y = place(-c * c5 * s6 - s * c6, -s5 * s6, -s * c5 * s6 + c * c6);
        const Vector z = place(-along, c5, -high);
        points.tcp = points.flange + (tcp[0] * x + (tcp[1] * y + tcp[2] * z));
    }
    return points;
}

struct Fastest {
    double fraction;  // of the Cartesian speed limit
    int64_t arm, point;
};

// Fastest point in the window and along the brake after it. Motion whose joint travel alone proves that it stays within
// `settled` is not computed, so that a result up to `settled` may be too small; with `settled` 0 it is exact.
static inline void faster_of(const Envelope& e, const double* from, const double* to, double settled, Fastest best[2]) {
    const double unit = 1.0 / (e.tick_s * e.tcp_speed_m_s);
    for (int64_t arm = 0; arm < 2; ++arm) {
        const double *start = from + 6 * arm, *stop = to + 6 * arm, *reach = e.reach_m + 6 * arm, *tcp = e.tcp_m + 3 * arm;
        double travel = 0.0;
        for (int64_t j = 0; j < 6; ++j) travel += fabs(stop[j] - start[j]) * reach[j];
        if (travel * unit <= larger(best[arm].fraction, settled)) continue;
        const double* lengths = e.lengths_m + 6 * arm;
        const Points a = points_of_arm(lengths, tcp, start), b = points_of_arm(lengths, tcp, stop);
        const double moved[3] = {squared(b.elbow - a.elbow), squared(b.flange - a.flange), squared(b.tcp - a.tcp)};
        for (int64_t point = 0; point < 3; ++point) {
            const double fraction = sqrt(moved[point]) * unit;
            if (fraction > best[arm].fraction || fraction != fraction) best[arm] = {fraction, arm, point};  // NaN stays
        }
    }
}

static inline void cartesian_use(const Envelope& e, const double* window, double settled, Fastest best[2]) {
    best[0] = {0.0, 0, 0};
    best[1] = {0.0, 1, 0};
    for (int64_t k = HISTORY; k < e.width; ++k)
        faster_of(e, window + (k - 1) * JOINTS, window + k * JOINTS, settled, best);
    double from[JOINTS], to[JOINTS];
    for (int64_t s = 0; s < e.stops; ++s) {
        const double* past = window + e.stop[s] * JOINTS;
        for (int64_t k = 0; k < e.samples; ++k) {
            weighted(e.brake_samples + 3 * k, 0, HISTORY, past, from);
            weighted(e.brake_samples + 3 * (e.samples + k), 0, HISTORY, past, to);
            for (int64_t j = 0; j < JOINTS; ++j) to[j] = from[j] + e.peak_between * (to[j] - from[j]);
            faster_of(e, from, to, settled, best);
        }
    }
}

static inline double cartesian_use(const Envelope& e, const double* window, double settled) {
    Fastest best[2];
    cartesian_use(e, window, settled, best);
    return larger_or_nan(best[0].fraction, best[1].fraction);
}

// True if the window keeps all limits up to a fraction `full` of the joints' and `cartesian_full` of the Cartesian one.
static inline bool is_legal(const Envelope& e, const double* window, double* scratch, double full,
                            double cartesian_full) {
    const Quantities quantities(e, window, scratch);
    double peak[JOINTS] = {}, fraction[JOINTS];
    for (int64_t row = 0; row < e.m; ++row) {
        quantities.fraction(row, fraction);
        if (!all_within(fraction, full)) return false;
        if (row < e.speed_rows) raise_peak(peak, fraction);
    }
    return cartesian_bound(e, peak) <= cartesian_full || cartesian_use(e, window, cartesian_full) <= cartesian_full;
}
