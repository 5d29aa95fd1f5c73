// Signed distances of capsules, boxes and planes in closed form; negative where two overlap.
#pragma once

#include "numbers.hpp"

enum Shape { CAPSULE = 0, BOX = 1, PLANE = 2 };  // a sphere is a capsule of no length

// A shape in the cell frame. A capsule lies along `axes.z`, and a plane's normal is `axes.z`.
struct Body {
    Shape shape;
    Vector center;
    Rotation axes;
    double size[3];  // capsule: radius, half length; box: half edges
    double radius;   // of the bounding sphere; 0 for a plane
};

static inline Vector end_of(const Body& capsule, double side) {
    return capsule.center + (side * capsule.size[1]) * capsule.axes.z;
}

static inline double to_segment(Vector point, Vector from, Vector along, double length2) {
    const Vector away = point - from;
    const double t = length2 > 0.0 ? clamp(dot(away, along) / length2, 0.0, 1.0) : 0.0;
    return squared(away - t * along);
}

// Distance of two capsules: of their axes, less the radii. The nearest points are inside both axes, or one is an end;
// every candidate is a pair of points of both, so nearly parallel axes need no special case.
static inline double capsule_capsule(const Body& a, const Body& b) {
    const Vector p = end_of(a, -1.0), q = end_of(b, -1.0);
    const Vector u = (2.0 * a.size[1]) * a.axes.z, v = (2.0 * b.size[1]) * b.axes.z, w = p - q;
    const double uu = squared(u), vv = squared(v), uv = dot(u, v), uw = dot(u, w), vw = dot(v, w);
    double least = smaller(smaller(to_segment(p, q, v, vv), to_segment(p + u, q, v, vv)),
                           smaller(to_segment(q, p, u, uu), to_segment(q + v, p, u, uu)));
    const double determinant = uu * vv - uv * uv;
    if (determinant > 0.0) {
        const double s = (uv * vw - vv * uw) / determinant, t = (uu * vw - uv * uw) / determinant;
        if (s > 0.0 && s < 1.0 && t > 0.0 && t < 1.0) least = smaller(least, squared(w + s * u - t * v));
    }
    return sqrt(least) - a.size[0] - b.size[0];
}

static inline double capsule_plane(const Body& capsule, const Body& plane) {
    const double height = dot(plane.axes.z, capsule.center - plane.center);
    return height - fabs(capsule.size[1] * dot(plane.axes.z, capsule.axes.z)) - capsule.size[0];
}

static inline double box_plane(const Body& box, const Body& plane) {
    const Vector n = rotate_back(box.axes, plane.axes.z);
    return dot(plane.axes.z, box.center - plane.center) -
           (fabs(n.x) * box.size[0] + fabs(n.y) * box.size[1] + fabs(n.z) * box.size[2]);
}

// Distance of a segment from a box, in the box's frame; 0 where they meet. Its square along the segment is convex and
// piecewise quadratic, with pieces that end where a coordinate crosses a face.
static inline double segment_box(Vector from, Vector along, const double* half) {
    const double p[3] = {from.x, from.y, from.z}, d[3] = {along.x, along.y, along.z};
    const auto beyond = [&](int i, double t) {
        const double x = p[i] + t * d[i];
        return x - clamp(x, -half[i], half[i]);
    };
    const auto slope = [&](double t) { return d[0] * beyond(0, t) + d[1] * beyond(1, t) + d[2] * beyond(2, t); };
    const auto distance = [&](double t) {
        const double x = beyond(0, t), y = beyond(1, t), z = beyond(2, t);
        return sqrt(x * x + y * y + z * z);
    };
    double low = 0.0, high = 1.0;
    double slope_low = slope(low), slope_high = slope(high);
    if (slope_low >= 0.0) return distance(low);
    if (slope_high <= 0.0) return distance(high);
    for (int i = 0; i < 3; ++i)
        for (int side = -1; side <= 1; side += 2) {
            if (d[i] == 0.0) continue;
            const double t = (side * half[i] - p[i]) / d[i];
            if (!(t > low && t < high)) continue;
            const double here = slope(t);
            if (here < 0.0) {
                low = t;
                slope_low = here;
            } else {
                high = t;
                slope_high = here;
            }
        }
    // The slope is linear between the two.
    return distance(slope_high > slope_low ? low + (high - low) * (-slope_low / (slope_high - slope_low)) : low);
}

constexpr double TOUCHING_M = 1e-12;  // an axis inside a box may be as far from it by rounding

static inline double capsule_box(const Body& capsule, const Body& box) {
    const Vector middle = rotate_back(box.axes, capsule.center - box.center);
    const Vector axis = rotate_back(box.axes, capsule.axes.z), along = (2.0 * capsule.size[1]) * axis;
    const double apart = segment_box(middle - 0.5 * along, along, box.size);
    if (apart > TOUCHING_M) return apart - capsule.size[0];
    // They overlap: the least translation that separates the axis from the box, along a normal of their sum.
    const double c[3] = {middle.x, middle.y, middle.z}, z[3] = {axis.x, axis.y, axis.z};
    double depth = INFINITY;
    for (int i = 0; i < 3; ++i) depth = smaller(depth, box.size[i] + fabs(capsule.size[1] * z[i]) - fabs(c[i]));
    for (int i = 0; i < 3; ++i) {
        const int j = (i + 1) % 3, k = (i + 2) % 3;
        const double length = sqrt(z[j] * z[j] + z[k] * z[k]);
        if (length * capsule.size[1] <= 1e-12) continue;
        const double spread = (box.size[j] * fabs(z[k]) + box.size[k] * fabs(z[j])) / length;
        depth = smaller(depth, spread - fabs(c[j] * z[k] - c[k] * z[j]) / length);
    }
    return -larger(depth, 0.0) - capsule.size[0];
}

// Distance of the corners of one box, and of its edges if asked for, from another box.
static inline double corners_box(const Body& a, const Body& b, bool edges) {
    double least = INFINITY;
    for (int corner = 0; corner < 8; ++corner) {
        const Vector local = {(corner & 1 ? a.size[0] : -a.size[0]), (corner & 2 ? a.size[1] : -a.size[1]),
                              (corner & 4 ? a.size[2] : -a.size[2])};
        const Vector from = rotate_back(b.axes, a.center + rotate(a.axes, local) - b.center);
        if (!edges) least = smaller(least, segment_box(from, {0.0, 0.0, 0.0}, b.size));
        for (int i = 0; edges && i < 3; ++i) {
            if (corner & (1 << i)) continue;
            const Vector axis = i == 0 ? a.axes.x : i == 1 ? a.axes.y : a.axes.z;
            least = smaller(least, segment_box(from, (2.0 * a.size[i]) * rotate_back(b.axes, axis), b.size));
        }
    }
    return least;
}

static inline double box_box(const Body& a, const Body& b) {
    // The largest separation along the normals of both, and of their sum's faces between two edges.
    const Vector away = b.center - a.center;
    const Vector first[3] = {a.axes.x, a.axes.y, a.axes.z}, second[3] = {b.axes.x, b.axes.y, b.axes.z};
    double separation = -INFINITY;
    const auto test = [&](Vector axis) {
        const double length = sqrt(squared(axis));
        if (length <= 1e-9) return;
        double spread = 0.0;
        for (int i = 0; i < 3; ++i) spread += a.size[i] * fabs(dot(first[i], axis)) + b.size[i] * fabs(dot(second[i], axis));
        separation = larger(separation, (fabs(dot(away, axis)) - spread) / length);
    };
    for (int i = 0; i < 3; ++i) {
        test(first[i]);
        test(second[i]);
        for (int j = 0; j < 3; ++j) test(cross(first[i], second[j]));
    }
    if (separation <= 0.0) return separation;
    // The nearest points lie on an edge of one, or are a corner of the other.
    return smaller(corners_box(a, b, true), corners_box(b, a, false));
}

// Signed distance of two bodies.
static inline double distance(const Body& a, const Body& b) {
    if (a.shape > b.shape) return distance(b, a);
    if (a.shape == CAPSULE) {
        if (b.shape == CAPSULE) return capsule_capsule(a, b);
        return b.shape == BOX ? capsule_box(a, b) : capsule_plane(a, b);
    }
    return b.shape == BOX ? box_box(a, b) : box_plane(a, b);
}

// A lower bound of the distance of two bodies, from their bounding spheres.
static inline double distance_of_spheres(const Body& a, const Body& b) {
    if (a.shape == PLANE) return dot(a.axes.z, b.center - a.center) - b.radius;
    if (b.shape == PLANE) return dot(b.axes.z, a.center - b.center) - a.radius;
    return sqrt(squared(a.center - b.center)) - a.radius - b.radius;
}
