// The floor of rbpf_indoor: the equations and random numbers of direct_rbpf.py, a loop over the particles a step.
//
// Particles lie innermost and their number is fixed (PARTICLES), so each loop is one that the compiler
// vectorises. Sine and cosine stand in loops of their own: of one loop GCC makes a joint call, which has no
// vector form.
#include <algorithm>
#include <cmath>
#include <cstdint>
#include <cstring>

namespace {
constexpr int N = PARTICLES;
constexpr int COUNTERS = (3 * N + 3) / 4;
using Row = double[N];

struct Cloud {
    Row log_weight, q[4], v[3], p[3], V[3][3], C[3][3], P[3][3];
};

struct Settings {  // as Python lays them out
    double gyro_noise, accelerometer_noise, position_noise, attitude_noise, resample_below, still, gravity;
};

alignas(64) Cloud cloud, other;
alignas(64) double weight[N], normal[4 * COUNTERS];
alignas(64) double scratch[8][N];
alignas(64) uint32_t words[4][COUNTERS];

void philox(uint32_t name, int64_t time, const uint32_t *seed, int count) {
    const uint32_t low = uint32_t(time), high = uint32_t(uint64_t(time) >> 32), k0 = seed[0], k1 = seed[1];
    for (int i = 0; i < count; i++) {
        uint32_t a = uint32_t(i), b = name, c = low, d = high;
        for (uint32_t r = 0; r < ROUNDS; r++) {
            const uint64_t x = uint64_t(a) * 0xD2511F53u, y = uint64_t(c) * 0xCD9E8D57u;
            a = uint32_t(y >> 32) ^ b ^ (k0 + 0x9E3779B9u * r);
            c = uint32_t(x >> 32) ^ d ^ (k1 + 0xBB67AE85u * r);
            b = uint32_t(y);
            d = uint32_t(x);
        }
        words[0][i] = a, words[1][i] = c, words[2][i] = b, words[3][i] = d;
    }
}

void draw_normals(const int32_t *start, const int32_t *slope) {
    const uint32_t *bits = words[0];
    for (int i = 0; i < 4 * COUNTERS; i++) {
        const float tail = float(int32_t((bits[i] >> 1) | 1u));
        int32_t form;
        std::memcpy(&form, &tail, 4);
        const int32_t segment = (form >> 17) - (127 << 6), place = (form & 0x1FFFF) >> 3;
        const int32_t size = start[segment] - ((slope[segment] * place + (1 << 13)) >> 14);
        normal[i] = double(bits[i] & 1u ? -size : size) * 0x1p-22;
    }
}

void predict(const double *reading, double dt, const Settings &set) {
    const double sigma = 0.5 * set.gyro_noise * std::sqrt(dt), h = 0.5 * dt;
    auto &half = scratch[0], &sine = scratch[1], &cosine = scratch[2];
    auto *u = scratch + 3;
    for (int i = 0; i < N; i++) {
        const double x = reading[0] * h + normal[i] * sigma, y = reading[1] * h + normal[N + i] * sigma,
                     z = reading[2] * h + normal[2 * N + i] * sigma;
        u[0][i] = x, u[1][i] = y, u[2][i] = z;
        half[i] = std::sqrt(std::max(x * x + y * y + z * z, 1e-30));
    }
    for (int i = 0; i < N; i++) sine[i] = std::sin(half[i]) / half[i];
    for (int i = 0; i < N; i++) cosine[i] = std::cos(half[i]);
    const double fx = reading[3], fy = reading[4], fz = reading[5];
    const double power = set.accelerometer_noise * set.accelerometer_noise;
    for (int i = 0; i < N; i++) {
        const double a = cosine[i], b = sine[i] * u[0][i], c = sine[i] * u[1][i], d = sine[i] * u[2][i];
        const double W = cloud.q[0][i], X = cloud.q[1][i], Y = cloud.q[2][i], Z = cloud.q[3][i];
        double w = W * a - X * b - Y * c - Z * d, x = W * b + X * a + Y * d - Z * c;
        double y = W * c - X * d + Y * a + Z * b, z = W * d + X * c - Y * b + Z * a;
        const double unit = 1.0 / std::sqrt(w * w + x * x + y * y + z * z);
        w *= unit, x *= unit, y *= unit, z *= unit;
        cloud.q[0][i] = w, cloud.q[1][i] = x, cloud.q[2][i] = y, cloud.q[3][i] = z;
        const double tx = 2.0 * (y * fz - z * fy), ty = 2.0 * (z * fx - x * fz), tz = 2.0 * (x * fy - y * fx);
        const double step[3] = {(fx + w * tx + y * tz - z * ty) * dt, (fy + w * ty + z * tx - x * tz) * dt,
                                (fz + w * tz + x * ty - y * tx + set.gravity) * dt};
        for (int k = 0; k < 3; k++) {
            cloud.p[k][i] += (cloud.v[k][i] + 0.5 * step[k]) * dt;
            cloud.v[k][i] += step[k];
        }
    }
    const double v = power * dt, c = 0.5 * v * dt, p = v * dt * dt / 3.0;
    for (int i = 0; i < N; i++) {
        double D[3][3];
        for (int a = 0; a < 3; a++)
            for (int b = 0; b < 3; b++) D[a][b] = cloud.C[a][b][i] + cloud.V[a][b][i] * dt;
        for (int a = 0; a < 3; a++)
            for (int b = a; b < 3; b++) {
                const double next = cloud.P[a][b][i] + (D[a][b] + cloud.C[b][a][i]) * dt + (a == b ? p : 0.0);
                cloud.P[a][b][i] = cloud.P[b][a][i] = next;
            }
        for (int a = 0; a < 3; a++) {
            for (int b = 0; b < 3; b++) cloud.C[a][b][i] = D[a][b] + (a == b ? c : 0.0);
            cloud.V[a][a][i] += v;
        }
    }
}

void update(const double *pose, const Settings &set) {
    const double w0 = pose[3], x0 = pose[4], y0 = pose[5], z0 = pose[6];
    const double r = set.position_noise * set.position_noise, precision = 1.0 / set.attitude_noise;
    auto &sine = scratch[0], &cosine = scratch[1], &angle = scratch[2], &determinant = scratch[3];
    auto &distance = scratch[4];
    for (int i = 0; i < N; i++) {
        const double w = cloud.q[0][i], x = cloud.q[1][i], y = cloud.q[2][i], z = cloud.q[3][i];
        const double a = w * x0 - x * w0 - y * z0 + z * y0, b = w * y0 + x * z0 - y * w0 - z * x0,
                     c = w * z0 - x * y0 + y * x0 - z * w0;
        sine[i] = std::sqrt(a * a + b * b + c * c);
        cosine[i] = std::fabs(w * w0 + x * x0 + y * y0 + z * z0);
    }
    for (int i = 0; i < N; i++) angle[i] = 2.0 * std::atan2(sine[i], cosine[i]) * precision;
    for (int i = 0; i < N; i++) {
        double C[3][3], P[3][3], e[3];
        for (int a = 0; a < 3; a++) {
            e[a] = pose[a] - cloud.p[a][i];
            for (int b = 0; b < 3; b++) C[a][b] = cloud.C[a][b][i], P[a][b] = cloud.P[a][b][i];
        }
        const double a = P[0][0] + r, b = P[0][1], c = P[0][2], d = P[1][1] + r, f = P[1][2], g = P[2][2] + r;
        const double A = d * g - f * f, B = c * f - b * g, D = b * f - c * d;
        const double det = a * A + b * B + c * D, over = 1.0 / det;
        const double I[3][3] = {{A * over, B * over, D * over},
                                {B * over, (a * g - c * c) * over, (b * c - a * f) * over},
                                {D * over, (b * c - a * f) * over, (a * d - b * b) * over}};
        double u[3], G[3][3];
        for (int k = 0; k < 3; k++) u[k] = I[k][0] * e[0] + I[k][1] * e[1] + I[k][2] * e[2];
        for (int k = 0; k < 3; k++)
            for (int l = 0; l < 3; l++) G[k][l] = I[k][0] * C[0][l] + I[k][1] * C[1][l] + I[k][2] * C[2][l];
        for (int k = 0; k < 3; k++) {
            cloud.v[k][i] += C[0][k] * u[0] + C[1][k] * u[1] + C[2][k] * u[2];
            cloud.p[k][i] += P[k][0] * u[0] + P[k][1] * u[1] + P[k][2] * u[2];
            for (int l = k; l < 3; l++) {
                const double less = C[0][k] * G[0][l] + C[1][k] * G[1][l] + C[2][k] * G[2][l];
                cloud.V[k][l][i] = cloud.V[l][k][i] = cloud.V[k][l][i] - less;
                const double left = r * (I[k][0] * P[0][l] + I[k][1] * P[1][l] + I[k][2] * P[2][l]);
                cloud.P[k][l][i] = cloud.P[l][k][i] = left;
            }
            for (int l = 0; l < 3; l++) cloud.C[k][l][i] = r * G[k][l];
        }
        determinant[i] = det;
        distance[i] = e[0] * u[0] + e[1] * u[1] + e[2] * u[2];
    }
    double largest = -INFINITY, sum = 0.0;
    for (int i = 0; i < N; i++) {
        const double by = distance[i] + std::log(determinant[i]) + angle[i] * angle[i];
        cloud.log_weight[i] -= 0.5 * by;
        largest = std::max(largest, cloud.log_weight[i]);
    }
    for (int i = 0; i < N; i++) sum += std::exp(cloud.log_weight[i] - largest);
    const double norm = largest + std::log(sum);
    for (int i = 0; i < N; i++) cloud.log_weight[i] -= norm;
}

void average(double *out) {
    double M[4][4] = {}, p[3] = {}, v[3] = {};
    for (int i = 0; i < N; i++) weight[i] = std::exp(cloud.log_weight[i]);
    for (int k = 0; k < 3; k++)
        for (int i = 0; i < N; i++) p[k] += cloud.p[k][i] * weight[i], v[k] += cloud.v[k][i] * weight[i];
    for (int a = 0; a < 4; a++)
        for (int b = a; b < 4; b++) {
            double sum = 0.0;
            for (int i = 0; i < N; i++) sum += cloud.q[a][i] * cloud.q[b][i] * weight[i];
            M[a][b] = M[b][a] = sum;
        }
    for (int n = 0; n < 5; n++) {
        double S[4][4];
        for (int a = 0; a < 4; a++)
            for (int b = 0; b < 4; b++)
                S[a][b] = M[a][0] * M[0][b] + M[a][1] * M[1][b] + M[a][2] * M[2][b] + M[a][3] * M[3][b];
        std::memcpy(M, S, sizeof M);
    }
    double q[4], norm = 0.0, trace = 0.0;
    int most = 0;
    for (int a = 0; a < 4; a++) {
        q[a] = 0.0;
        for (int b = 0; b < 4; b++) q[a] += M[a][b] * cloud.q[b][0];
        norm += q[a] * q[a], trace += M[a][a] * M[a][a];
        most = M[a][a] > M[most][most] ? a : most;
    }
    if (norm <= 1e-6 * trace) {
        norm = 0.0;
        for (int a = 0; a < 4; a++) q[a] = M[a][most], norm += q[a] * q[a];
    }
    std::memcpy(out, p, sizeof p);
    std::memcpy(out + 3, v, sizeof v);
    for (int a = 0; a < 4; a++) out[6 + a] = q[a] / std::sqrt(norm);
}

void resample(double u, int32_t *index) {
    static int64_t ends[N];
    int64_t total = 0;
    for (int i = 0; i < N; i++) ends[i] = total += int64_t(std::floor(weight[i] * 0x1p38 + 0.5));
    const int64_t shift = int64_t(std::floor(u * double(total)));
    for (int64_t j = 0, i = 0; j < N; j++) {
        const int64_t place = (j * total + shift) / N;
        while (ends[i] <= place) i++;
        index[j] = int32_t(i);
    }
    double *to = &other.q[0][0];
    const double *from = &cloud.q[0][0];
    for (int k = 0; k < int(sizeof(Cloud) / sizeof(Row)) - 1; k++)
        for (int i = 0; i < N; i++) to[k * N + i] = from[k * N + index[i]];
    std::memcpy(cloud.q, other.q, sizeof(Cloud) - sizeof(Row));
    std::fill_n(cloud.log_weight, N, -std::log(double(N)));
}
}  // namespace

extern "C" void floor_rbpf(int64_t ticks, const int64_t *time, const int64_t *imu_index, const int64_t *pose_index,
                           const double *imu, const double *poses, const double *start, const Settings *set,
                           const uint32_t *seed, const uint32_t *names, const int32_t *nodes, const int32_t *slope,
                           double *out, double *sizes, bool *resampled, int32_t *index) {
    std::memcpy(&cloud, start, sizeof cloud);
    double reading[6] = {0.0, 0.0, 0.0, 0.0, 0.0, 9.81}, bias[6] = {};
    double last[6] = {0.0, 0.0, 0.0, 0.0, 0.0, 9.81}, drive[6];
    int64_t count = 0, first = 0;
    for (int64_t t = 0, k = 0; t < ticks; t++) {
        const double dt = double(time[t] - time[t ? t - 1 : 0]) * 1e-9;
        if (imu_index[t] >= 0) {
            std::memcpy(reading, imu + 6 * imu_index[t], sizeof reading);
            if (set->still > 0.0) {
                if (count == 0) first = time[t];
                if (time[t] - first <= int64_t(std::llround(set->still * 1e9))) {
                    count++;
                    for (int i = 0; i < 6; i++)
                        bias[i] += (reading[i] + (i == 5 ? set->gravity : 0.0) - bias[i]) / double(count);
                }
                for (int i = 0; i < 6; i++) reading[i] -= bias[i];
            }
        }
        philox(names[0], time[t], seed, COUNTERS);
        draw_normals(nodes, slope);
        for (int i = 0; i < 6; i++) drive[i] = 0.5 * (last[i] + reading[i]);
        std::memcpy(last, reading, sizeof last);
        predict(drive, dt, *set);
        const bool seen = pose_index[t] >= 0;
        if (seen) update(poses + 7 * pose_index[t], *set);
        average(out + 10 * t);
        if (seen) {
            double squares = 0.0;
            for (int i = 0; i < N; i++) squares += weight[i] * weight[i];
            sizes[k] = 1.0 / squares;
            resampled[k] = sizes[k] < set->resample_below * N;
            if (resampled[k]) {
                philox(names[1], time[t], seed, 1);
                resample(double(words[0][0] >> 8) * 0x1p-24, index + k * N);
            } else {
                for (int i = 0; i < N; i++) index[k * N + i] = i;
            }
            k++;
        }
    }
}
