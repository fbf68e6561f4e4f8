// The floor of the unscented step: 15 states, 6 measurements, 31 sigma points for each of predict and update.
//
// Sigma points lie innermost, so the strapdown model is one loop that the compiler vectorises (sines and
// cosines in loops of their own: of one loop GCC makes a joint call, which has no vector form); the linear
// algebra is Eigen's with fixed sizes. The forms are those of blocks/unscented.py: deviations from the central
// image, and a covariance that is a sum of squares.
#include <Eigen/Dense>
#include <cmath>
#include <cstdint>

namespace {
constexpr int N = 15, M = 6, OUTER = 2 * N;
using State = Eigen::Matrix<double, N, 1>;
using Covariance = Eigen::Matrix<double, N, N, Eigen::RowMajor>;
using Measurement = Eigen::Matrix<double, M, 1>;
using Small = Eigen::Matrix<double, M, M>;
using Gain = Eigen::Matrix<double, N, M>;
using Points = Eigen::Matrix<double, N, 32, Eigen::RowMajor>;  // 30 outer ones, the centre, and one to fill up
using Apart = Eigen::Matrix<double, N, OUTER, Eigen::RowMajor>;
using Seen = Eigen::Matrix<double, M, OUTER, Eigen::RowMajor>;

const double SCALE = std::sqrt(double(N)), WEIGHT = 0.5 / double(N), CENTRAL = 2.0 - 1.0;  // alpha 1, beta 2

void spread(const Covariance &P, Apart &apart) {
    const Eigen::LLT<Covariance> root(P);
    const Covariance L = root.matrixL();
    apart.leftCols<N>() = SCALE * L;
    apart.rightCols<N>() = -SCALE * L;
}

void move(Points &X, const double *imu, double dt) {
    alignas(64) double sine[3][32], cosine[3][32];
    for (int a = 0; a < 3; a++) {
        for (int i = 0; i < 32; i++) sine[a][i] = std::sin(X(6 + a, i));
        for (int i = 0; i < 32; i++) cosine[a][i] = std::cos(X(6 + a, i));
    }
    for (int i = 0; i < 32; i++) {
        const double sr = sine[0][i], cr = cosine[0][i], sp = sine[1][i], cp = cosine[1][i];
        const double sy = sine[2][i], cy = cosine[2][i];
        const double wx = imu[0] - X(9, i), wy = imu[1] - X(10, i), wz = imu[2] - X(11, i);
        const double fx = imu[3] - X(12, i), fy = imu[4] - X(13, i), fz = imu[5] - X(14, i);
        const double level = sr * wy + cr * wz, side = sr * fy + cr * fz, ahead = cp * fx + sp * side;
        const double left = cr * fy - sr * fz;
        for (int k = 0; k < 3; k++) X(k, i) += X(3 + k, i) * dt;
        X(3, i) += (cy * ahead - sy * left) * dt;
        X(4, i) += (sy * ahead + cy * left) * dt;
        X(5, i) += (cp * side - sp * fx - 9.81) * dt;
        X(6, i) += (wx + level * sp / cp) * dt;
        X(7, i) += (cr * wy - sr * wz) * dt;
        X(8, i) += level / cp * dt;
    }
}
}  // namespace

extern "C" void floor_ukf(int64_t ticks, double step, const double *model, const double *imu,
                          const double *measured, double *mean, double *covariance) {
    const State Q = Eigen::Map<const State>(model);
    const Measurement R = Eigen::Map<const Measurement>(model + N);
    State x = Eigen::Map<const State>(model + N + M);
    Covariance P = Eigen::Map<const Covariance>(model + 2 * N + M);
    for (int64_t t = 0; t < ticks; t++) {
        const double dt = t ? step : 0.0;
        Apart apart;
        Points X;
        spread(P, apart);
        X.leftCols<OUTER>() = apart.colwise() + x;
        X.col(OUTER) = X.col(OUTER + 1) = x;
        move(X, imu + 6 * t, dt);
        apart = X.leftCols<OUTER>().colwise() - X.col(OUTER);
        const State shift = WEIGHT * apart.rowwise().sum();
        x = X.col(OUTER) + shift;
        P.setZero();
        P.selfadjointView<Eigen::Lower>().rankUpdate(apart, WEIGHT);
        P.selfadjointView<Eigen::Lower>().rankUpdate(shift, CENTRAL);
        P = P.selfadjointView<Eigen::Lower>();
        P.diagonal() += Q * dt;

        spread(P, apart);
        Seen seen;
        for (int k = 0; k < 3; k++) {
            seen.row(k) = apart.row(k);  // what is measured: position and angles, linear in the state
            seen.row(3 + k) = apart.row(6 + k);
        }
        Measurement centre, off = WEIGHT * seen.rowwise().sum();
        centre << x.head<3>(), x.segment<3>(6);
        Small S;
        S.noalias() = WEIGHT * (seen * seen.transpose()).eval();
        S.noalias() += CENTRAL * off * off.transpose();
        S.diagonal() += R;
        Gain C;
        C.noalias() = apart.lazyProduct(seen.transpose());
        C *= WEIGHT;
        const Gain K = S.llt().solve(C.transpose()).transpose();
        const Measurement residual = Eigen::Map<const Measurement>(measured + M * t) - centre - off;
        apart.noalias() -= K * seen;
        const State rest = K * off;
        const Gain KR = K * R.cwiseSqrt().asDiagonal();
        x.noalias() += K * residual;
        P.setZero();
        P.selfadjointView<Eigen::Lower>().rankUpdate(apart, WEIGHT);
        P.selfadjointView<Eigen::Lower>().rankUpdate(rest, CENTRAL);
        P.selfadjointView<Eigen::Lower>().rankUpdate(KR);
        P = P.selfadjointView<Eigen::Lower>();
        Eigen::Map<State>(mean + N * t) = x;
        Eigen::Map<Covariance>(covariance + N * N * t) = P;
    }
}
