// Small dense linear algebra in double precision.
#pragma once

#include <cmath>
#include <utility>

#include "clones.hpp"

namespace seamark {

// Solves A x = b in place of b (n); A (n, n) with rows `stride` apart is overwritten. Gaussian elimination with partial
// pivoting, no square roots. Returns false when A is singular.
SEAMARK_INLINE bool solve(double* A, int n, int stride, double* b) {
    for (int k = 0; k < n; ++k) {
        int best = k;
        for (int i = k + 1; i < n; ++i)
            if (std::fabs(A[i * stride + k]) > std::fabs(A[best * stride + k])) best = i;
        if (!(std::fabs(A[best * stride + k]) > 0)) return false;
        if (best != k) {
            for (int j = k; j < n; ++j) std::swap(A[k * stride + j], A[best * stride + j]);
            std::swap(b[k], b[best]);
        }
        const double* pivot = A + k * stride;
        for (int i = k + 1; i < n; ++i) {
            double* row = A + i * stride;
            const double factor = row[k] / pivot[k];
            for (int j = k + 1; j < n; ++j) row[j] -= factor * pivot[j];
            b[i] -= factor * b[k];
        }
    }
    for (int i = n - 1; i >= 0; --i) {
        double sum = b[i];
        for (int j = i + 1; j < n; ++j) sum -= A[i * stride + j] * b[j];
        b[i] = sum / A[i * stride + i];
    }
    return true;
}

// Inverts a symmetric positive definite (3, 3) matrix through L D L^T. Returns false when it is not.
SEAMARK_INLINE bool invert3(const double* A, double* inverse) {
    const double d0 = A[0], l10 = A[3] / d0, l20 = A[6] / d0;
    const double d1 = A[4] - l10 * A[3], l21 = (A[7] - l20 * A[3]) / d1;
    const double d2 = A[8] - l20 * A[6] - l21 * l21 * d1;
    if (!(d0 > 0 && d1 > 0 && d2 > 0)) return false;
    const double m20 = l10 * l21 - l20, e0 = 1 / d0, e1 = 1 / d1, e2 = 1 / d2;  // L^-1 has -l10, -l21 and m20
    inverse[0] = e0 + l10 * l10 * e1 + m20 * m20 * e2;
    inverse[1] = inverse[3] = -l10 * e1 - m20 * l21 * e2;
    inverse[2] = inverse[6] = m20 * e2;
    inverse[4] = e1 + l21 * l21 * e2;
    inverse[5] = inverse[7] = -l21 * e2;
    inverse[8] = e2;
    return true;
}

}  // namespace seamark
