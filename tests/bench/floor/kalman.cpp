// The floor of the linear Kalman step: 6 states, 3 measurements, Joseph form, fixed-size Eigen.
//
// Columns are eight long, one vector register each, of which the last two stay zero: products of them are
// multiply-adds of whole registers, where six leave the compiler with pieces.
#include <Eigen/Dense>
#include <cmath>
#include <cstdint>

using Matrix6 = Eigen::Matrix<double, 6, 6>;
using Padded6 = Eigen::Matrix<double, 8, 6>;
using Padded3 = Eigen::Matrix<double, 8, 3>;
using Padded = Eigen::Matrix<double, 8, 1>;
using Matrix3 = Eigen::Matrix<double, 3, 3>;
using Vector3 = Eigen::Matrix<double, 3, 1>;

namespace {
// out += A B, a column at a time
template <int Inner, int Columns, class Left, class Right, class Out>
inline void add_product(Out &out, const Left &A, const Right &B) {
    for (int j = 0; j < Columns; j++) {
        Padded sum = out.col(j);
        for (int k = 0; k < Inner; k++) sum += A.col(k) * B(k, j);
        out.col(j) = sum;
    }
}
}  // namespace

extern "C" void floor_kalman(int64_t ticks, const double *model, const double *measured, double *mean,
                             double *covariance) {
    using Given6 = Eigen::Map<const Eigen::Matrix<double, 6, 6, Eigen::RowMajor>>;
    using Given36 = Eigen::Map<const Eigen::Matrix<double, 3, 6, Eigen::RowMajor>>;
    using Given3 = Eigen::Map<const Eigen::Matrix<double, 3, 3, Eigen::RowMajor>>;
    Padded6 F = Padded6::Zero(), Q = F, P = F;
    Padded3 HT = Padded3::Zero();
    F.topRows<6>() = Given6(model);
    Q.topRows<6>() = Given6(model + 36);
    HT.topRows<6>() = Given36(model + 72).transpose();
    P.topRows<6>() = Given6(model + 105);
    const Matrix6 FT = F.topRows<6>().transpose();
    const Eigen::Matrix<double, 6, 3> HT6 = HT.topRows<6>();
    const Matrix3 R = Given3(model + 90);
    Padded x = Padded::Zero();
    x.head<6>() = Eigen::Map<const Eigen::Matrix<double, 6, 1>>(model + 99);
    for (int64_t t = 0; t < ticks; t++) {
        const Vector3 z = Eigen::Map<const Vector3>(measured + 3 * t);
        Padded m = Padded::Zero();
        for (int k = 0; k < 6; k++) m += F.col(k) * x(k);
        Padded6 FP = Padded6::Zero(), prior = Q;
        add_product<6, 6>(FP, F, P);
        add_product<6, 6>(prior, FP, FT);
        Padded3 PHT = Padded3::Zero();
        add_product<6, 3>(PHT, prior, HT6);
        Matrix3 S = R;
        S.noalias() += HT6.transpose().lazyProduct(PHT.topRows<6>());
        // K^T = S^-1 (P H^T)^T by Cholesky, on whole columns of K
        const double l00 = 1.0 / std::sqrt(S(0, 0)), l10 = S(1, 0) * l00, l20 = S(2, 0) * l00;
        const double l11 = 1.0 / std::sqrt(S(1, 1) - l10 * l10), l21 = (S(2, 1) - l20 * l10) * l11;
        const double l22 = 1.0 / std::sqrt(S(2, 2) - l20 * l20 - l21 * l21);
        Padded3 K;
        const Padded a = PHT.col(0) * l00, b = (PHT.col(1) - a * l10) * l11;
        K.col(2) = (PHT.col(2) - a * l20 - b * l21) * (l22 * l22);
        K.col(1) = (b - K.col(2) * l21) * l11;
        K.col(0) = (a - K.col(1) * l10 - K.col(2) * l20) * l00;
        const Vector3 residual = z - HT6.transpose().lazyProduct(m.head<6>());
        x = m + K.col(0) * residual(0) + K.col(1) * residual(1) + K.col(2) * residual(2);
        Padded6 left = Padded6::Zero();
        left.diagonal().setOnes();
        add_product<3, 6>(left, Padded3(-K), HT6.transpose());
        Padded6 LP = Padded6::Zero(), after = Padded6::Zero();
        add_product<6, 6>(LP, left, prior);
        add_product<6, 6>(after, LP, Matrix6(left.topRows<6>().transpose()));
        Padded3 KR = Padded3::Zero();
        add_product<3, 3>(KR, K, R);
        add_product<3, 6>(after, KR, Eigen::Matrix<double, 3, 6>(K.topRows<6>().transpose()));
        P.topRows<6>() = 0.5 * (after.topRows<6>() + after.topRows<6>().transpose());
        Eigen::Map<Eigen::Matrix<double, 6, 1>>(mean + 6 * t) = x.head<6>();
        Eigen::Map<Matrix6>(covariance + 36 * t) = P.topRows<6>();
    }
}
