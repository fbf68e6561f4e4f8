// The floor of the linear Kalman step: 6 states, 3 measurements, Joseph form, fixed-size Eigen.
#include <Eigen/Dense>
#include <cstdint>

using Matrix6 = Eigen::Matrix<double, 6, 6, Eigen::RowMajor>;
using Matrix36 = Eigen::Matrix<double, 3, 6, Eigen::RowMajor>;
using Matrix3 = Eigen::Matrix<double, 3, 3, Eigen::RowMajor>;
using Vector6 = Eigen::Matrix<double, 6, 1>;
using Vector3 = Eigen::Matrix<double, 3, 1>;

extern "C" void floor_kalman(int64_t ticks, const double *model, const double *measured, double *mean,
                             double *covariance) {
    const Matrix6 F = Eigen::Map<const Matrix6>(model);
    const Matrix6 Q = Eigen::Map<const Matrix6>(model + 36);
    const Matrix36 H = Eigen::Map<const Matrix36>(model + 72);
    const Matrix3 R = Eigen::Map<const Matrix3>(model + 90);
    Vector6 x = Eigen::Map<const Vector6>(model + 99);
    Matrix6 P = Eigen::Map<const Matrix6>(model + 105);
    for (int64_t t = 0; t < ticks; t++) {
        const Vector3 z = Eigen::Map<const Vector3>(measured + 3 * t);
        const Vector6 m = F * x;
        Matrix6 FP;
        FP.noalias() = F * P;
        Matrix6 prior = Q;
        prior.noalias() += FP * F.transpose();
        Matrix36 HP;
        HP.noalias() = H * prior;
        Matrix3 S = R;
        S.noalias() += HP * H.transpose();
        const Eigen::Matrix<double, 6, 3> K = S.llt().solve(HP).transpose();
        x = m + K * (z - H * m);
        Matrix6 left = Matrix6::Identity();
        left.noalias() -= K * H;
        Matrix6 LP;
        LP.noalias() = left * prior;
        Eigen::Matrix<double, 6, 3> KR;
        KR.noalias() = K * R;
        P.noalias() = LP * left.transpose();
        P.noalias() += KR * K.transpose();
        P = (0.5 * (P + P.transpose())).eval();
        Eigen::Map<Vector6>(mean + 6 * t) = x;
        Eigen::Map<Matrix6>(covariance + 36 * t) = P;
    }
}
