// Inverse kinematics of one arm in closed form; see `ur_core.kinematics.inverse`.
#pragma once

#include "fields.hpp"
#include "numbers.hpp"

namespace {

constexpr double TINIEST = 1e-300;
constexpr double WRIST_SINGULAR = 1e-8;  // below this sine of theta5 theta6 is free: it moves the flange by less
constexpr double WRIST_BLURRED = 1e-3;   // up to this one, rounding of the pose blurs theta6 enough to matter
constexpr double BLUR_RAD = 1e-11;
// By how much rounding alone puts an angle past the end of its range: at a stretched arm by its root. Bringing it back
// moves the flange by less than is allowed at the edge of reach.
constexpr double ROUNDED_RAD = 5e-8;
constexpr double PI = 3.14159265358979323846;

struct Branch {
    double q[6], offset2, cosine3;
};

// One branch, by the signs of elbow, wrist and shoulder. Every angle comes from an arc tangent of its sine and cosine,
// and each later one compensates the rounding of the previous ones, so that the pose is exact to rounding also at
// singularities. `columns` are the flange's axes, and `theta6` is the reference where that angle is free.
Branch branch(const double* lengths, Vector position, const Rotation& columns, double elbow, double wrist,
              double shoulder, double theta6, double edge) {
    const double d1 = lengths[0], a2 = lengths[1], a3 = lengths[2], d4 = lengths[3], d5 = lengths[4], d6 = lengths[5];
    const Vector center = position - d6 * columns.z;  // of the wrist
    Branch result;

    // Theta1 puts the wrist centre at d4 beside the arm's plane; along the plane it is then at `along`.
    const double radius2 = center.x * center.x + center.y * center.y;
    result.offset2 = radius2 - d4 * d4;
    const double along = shoulder * sqrt(larger(result.offset2, 0.0)), scale1 = 1.0 / larger(radius2, TINIEST);
    const double sin1 = (along * center.y + d4 * center.x) * scale1, cos1 = (along * center.x - d4 * center.y) * scale1;

    // Theta5 and theta6 from the normal of the arm's plane, seen from the flange.
    const Vector normal = rotate_back(columns, {sin1, -cos1, 0.0});
    const double sin5 = sqrt(normal.x * normal.x + normal.y * normal.y), scale = wrist / larger(sin5, TINIEST);
    double cos6 = normal.x * scale, sin6 = -normal.y * scale;
    if (sin5 < WRIST_BLURRED) {
        const SineCosine free6 = sine_cosine(theta6);
        // Take the reference's theta6 wherever that rotates the flange by hardly more than rounding does. Where any does,
        // the two branches of the wrist take opposite ones, so that they differ.
        const bool blurred = fabs(normal.x * free6.sine + normal.y * free6.cosine) < BLUR_RAD;
        const double side = sin5 < WRIST_SINGULAR ? wrist : 1.0;
        if (sin5 < WRIST_SINGULAR || (blurred && cos6 * free6.cosine + sin6 * free6.sine > 0.0)) {
            cos6 = side * free6.cosine;
            sin6 = side * free6.sine;
        }
        // Where that asks too much of a stretched arm, let wrist 2's axis point from the shoulder to the wrist centre,
        // which spares it most.
        const double height = center.z - d1, length = sqrt(along * along + height * height);
        const Vector axis = sin6 * columns.x + cos6 * columns.y;
        const double gain = -d5 * ((axis.x * cos1 + axis.y * sin1) * along + axis.z * height);
        const bool far = length * length + d5 * d5 - 2.0 * gain > (a2 + a3) * (a2 + a3) * (1.0 + 0.1 * edge);
        if (far && sin5 < WRIST_SINGULAR) {
            const Vector outward = (1.0 / larger(length, TINIEST)) * Vector{cos1 * along, sin1 * along, height};
            sin6 = -dot(columns.x, outward);
            cos6 = -dot(columns.y, outward);
        }
    }

    // Wrist 2's axis lies in the arm's plane, a quarter turn behind theta2 + theta3 + theta4.
    const Vector axis = sin6 * columns.x + cos6 * columns.y;
    const double cos234 = axis.z, sin234 = -(axis.x * cos1 + axis.y * sin1);

    // A triangle of upper arm and forearm remains.
    const double x = along - d5 * sin234, y = (center.z - d1) + d5 * cos234;
    const double cos3 = (x * x + y * y - (a2 * a2 + a3 * a3)) * (0.5 / (a2 * a3));
    const double sin3 = elbow * sqrt(larger(1.0 - cos3 * cos3, 0.0)), near = a2 + a3 * cos3, beside = a3 * sin3;
    result.cosine3 = cos3;
    result.q[0] = atan2(sin1, cos1);
    result.q[1] = atan2(y * near - x * beside, x * near + y * beside);
    result.q[2] = atan2(sin3, cos3);
    result.q[3] = atan2(sin234, cos234) - result.q[1] - result.q[2];
    result.q[4] = atan2(wrist * sin5, normal.z);
    result.q[5] = atan2(sin6, cos6);
    return result;
}

// All branches of a row of `position, rotation, reference`, (18,), in the order of their signs.
void branches(const double* arm, const double* row, Branch* found) {
    const double *lengths = arm, *theta = arm + 6, edge = arm[12];
    for (int k = 0; k < 8; ++k) {
        found[k] = branch(lengths, vector(row), rotation(row + 3), k & 4 ? -1.0 : 1.0, k & 2 ? -1.0 : 1.0,
                          k & 1 ? -1.0 : 1.0, row[17] + theta[5], edge);
        for (int j = 0; j < 6; ++j) found[k].q[j] -= theta[j];
    }
}

// Keep a solution, with full rotations within the joint range, if it is nearer to the reference than the nearest yet.
void keep_nearer(const double* solution, const double* reference, const double* range, double& least, double* q) {
    double nearest[6], distance = 0.0;
    for (int j = 0; j < 6; ++j) {
        double turned = solution[j] + 2.0 * PI * rint((reference[j] - solution[j]) / (2.0 * PI));
        if (fabs(turned) > range[j] + ROUNDED_RAD) turned -= copysign(2.0 * PI, turned);
        nearest[j] = clamp(turned, -range[j], range[j]);
        distance += (turned - reference[j]) * (turned - reference[j]);
    }
    if (!(distance < least)) return;
    least = distance;
    copy(q, nearest, 6);
}

// Check a row of position, rotation and reference, and bring the reference into the joint range. Return 0, or for a part
// that is not finite or no rotation: -1 position, -2 rotation, -3 reference. `limits` holds the joint range, and by how
// much the product of a rotation with its transpose may differ from 1.
double check(const double* limits, double* row) {
    for (int k = 0; k < 3; ++k)
        if (!(fabs(row[k]) < INFINITY)) return -1.0;
    for (int i = 0; i < 3; ++i)
        for (int j = 0; j <= i; ++j) {
            const double product = dot(vector(row + 3 + 3 * i), vector(row + 3 + 3 * j));
            if (!(fabs(product - (i == j)) < limits[6])) return -2.0;
        }
    for (int j = 0; j < 6; ++j) {
        if (!(fabs(row[12 + j]) < INFINITY)) return -3.0;
        row[12 + j] = clamp(row[12 + j], -limits[j], limits[j]);
    }
    return 0.0;
}

}  // namespace

// Check rows of `block`, (n, 19): position, rotation and reference; the last number takes the result of `check`.
SIZES(inverse_check, "7 19*$2 -")
EXPORT void inverse_check(const double* limits, double* block, int64_t n) {
    for (int64_t row = 0; row < n; ++row) block[19 * row + 18] = check(limits, block + 19 * row);
}

// All eight branches of flange poses of an arm with exactly parallel and perpendicular axes; `arm` holds its lengths, its
// theta offsets and the tolerance at the edge. A row of `block` (n, 75) gives position, rotation and reference, and takes
// angles (8, 6), not wrapped, cosines of theta3 (8,), and the square of the wrist centre's distance from the base axis
// less that of d4.
SIZES(inverse_branches, "13 75*$2 -")
EXPORT void inverse_branches(const double* arm, double* block, int64_t n) {
    for (int64_t row = 0; row < n; ++row) {
        double* here = block + 75 * row;
        Branch found[8];
        branches(arm, here, found);
        for (int k = 0; k < 8; ++k) {
            copy(here + 18 + 6 * k, found[k].q, 6);
            here[66 + k] = found[k].cosine3;
        }
        here[74] = found[0].offset2;
    }
}

// The branch nearest to the reference. A row of `block` (n, 25) gives position, rotation and reference, and takes angles
// (6,), the reference where none is in reach, and 1 if one is; or the result of `check` for a row that is not solved.
SIZES(inverse_nearest, "13 7 25*$3 -")
EXPORT void inverse_nearest(const double* arm, const double* limits, double* block, int64_t n) {
    const double edge = arm[12];
    for (int64_t row = 0; row < n; ++row) {
        double *here = block + 25 * row, *q = here + 18, least = INFINITY;
        if ((here[24] = check(limits, here)) < 0.0) continue;
        copy(q, here + 12, 6);
        Branch found[8];
        branches(arm, here, found);
        for (int k = 0; k < 8; ++k)
            if (fabs(found[k].cosine3) <= 1.0 + edge && found[k].offset2 >= -edge)
                keep_nearer(found[k].q, here + 12, limits, least, q);
        here[24] = least < INFINITY ? 1.0 : 0.0;
    }
}

// The same of given solutions (n, count, 6), of which those with a 1 in `valid` (n, count) count.
SIZES(inverse_nearest_of, "6*$6*$7 $6*$7 6*$7 7 6*$7 $7 - -")
EXPORT void inverse_nearest_of(const double* solutions, const double* valid, const double* reference,
                               const double* range, double* q, double* reached, int64_t count, int64_t n) {
    for (int64_t row = 0; row < n; ++row) {
        double least = INFINITY;
        copy(q + 6 * row, reference + 6 * row, 6);
        for (int64_t k = 0; k < count; ++k)
            if (valid[row * count + k] != 0.0)
                keep_nearer(solutions + (row * count + k) * 6, reference + 6 * row, range, least, q + 6 * row);
        reached[row] = least < INFINITY ? 1.0 : 0.0;
    }
}
