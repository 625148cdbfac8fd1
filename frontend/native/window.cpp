#include "window.hpp"

#include <algorithm>
#include <cstring>
#include <limits>

#include "linear.hpp"

namespace seamark {
namespace {

constexpr double kHold = 1e-9;  // added to all diagonals
constexpr double kNearest = 1e-2;

// A row of a pose: six numbers and two zeros. GCC holds vectors to an alignment that depends on the level it compiles
// for, so none is asked of the type.
typedef double Row __attribute__((vector_size(64), aligned(8)));

struct alignas(64) Line {
    Row row;
};

// One observation at a linearisation, weighted. What belongs to a pose is there only for one that is free.
struct alignas(64) Term {
    double r[3];
    double J_landmark[3][3];
    double J_depth;    // of the third residual by the offset
    Row J_pose[3];
    int64_t free;      // number among the free poses, negative for one that is held
};

// J_pose^T J_landmark of an observation, transposed.
struct alignas(64) Cross {
    Row row[3];
};

// The robust cost of a state and each observation's error.
struct Fit {
    std::vector<double> errors;
    double cost = 0;
};

// Sees observation i from a state; returns what the third residual changes by with the offset.
SEAMARK_INLINE double look(const Bundle& bundle, const Adjusted& state, int64_t i, double* p, Residual& at) {
    const double* T = state.poses.data() + 16 * bundle.keyframe_of[i];
    into_camera(T, state.landmarks.data() + 3 * bundle.landmark_of[i], p);
    p[2] = std::max(p[2], kNearest);
    observe(p, bundle.seen, i, bundle.lens, at);
    const double by_offset = std::isfinite(bundle.seen.inverse_depth[i]) ? -1 / bundle.seen.inverse_sigma[i] : 0;
    at.r[2] += by_offset * state.offset;
    return by_offset;
}

SEAMARK_CLONES void evaluate(const Bundle& bundle, const Adjusted& state, Fit& out) {
    const double off = state.offset - bundle.offset;
    double cost = 0.5 * bundle.offset_information * off * off;
    for (int64_t i = 0; i < bundle.seen.n; ++i) {
        double p[3];
        Residual at;
        look(bundle, state, i, p, at);
        out.errors[i] = std::sqrt(at.r[0] * at.r[0] + at.r[1] * at.r[1]);
        cost += huber_cost(out.errors[i]) + huber_cost(std::fabs(at.r[2]));
    }
    out.cost = cost;
}

SEAMARK_INLINE void linearise(const Bundle& bundle, const Adjusted& state, int64_t i, Term& term, Cross& W) {
    const double* T = state.poses.data() + 16 * bundle.keyframe_of[i];
    double p[3];
    Residual at;
    const double by_offset = look(bundle, state, i, p, at);
    const double of_pixel = std::sqrt(huber_weight(std::sqrt(at.r[0] * at.r[0] + at.r[1] * at.r[1])));
    const double root[3] = {of_pixel, of_pixel, std::sqrt(huber_weight(std::fabs(at.r[2])))};
    term.J_depth = by_offset * root[2];
    term.free = bundle.keyframe_of[i] - bundle.n_fixed;
    for (int k = 0; k < 3; ++k) {
        term.r[k] = at.r[k] * root[k];
        for (int j = 0; j < 3; ++j)  // J_point R^T
            term.J_landmark[k][j] =
                (at.J[k][0] * T[4 * j] + at.J[k][1] * T[4 * j + 1] + at.J[k][2] * T[4 * j + 2]) * root[k];
    }
    if (term.free < 0) return;
    double J[3][6];
    by_pose(at.J, p, J);
    for (int k = 0; k < 3; ++k)
        term.J_pose[k] = Row{J[k][0], J[k][1], J[k][2], J[k][3], J[k][4], J[k][5], 0, 0} * root[k];
    for (int j = 0; j < 3; ++j)
        W.row[j] = term.J_pose[0] * term.J_landmark[0][j] + term.J_pose[1] * term.J_landmark[1][j] +
                   term.J_pose[2] * term.J_landmark[2][j];
}

// The normal equations with the landmarks eliminated: 6 rows per free pose, then one of the depth offset.
struct Reduced {
    std::vector<Line> blocks;           // (F, F, 6) rows: those on and right of the diagonal
    std::vector<Line> own_blocks;       // (F, 6) rows of the poses before the elimination
    std::vector<Line> b, across;        // (F,) and the column of the offset
    double own = 0, pull = 0;           // the offset's diagonal, and its b
    std::vector<double> inverse;        // (L, 3, 3)
    std::vector<double> b_landmark, W_depth;  // (L, 3)
    std::vector<Cross> W;               // (O,)
    std::vector<Term> terms;            // of one landmark
    bool solvable = true;
};

SEAMARK_INLINE void times(const Row* W, const double* v, Row& out) {
    out = W[0] * v[0] + W[1] * v[1] + W[2] * v[2];
}

// Adds what an observation says of its pose and of the offset.
SEAMARK_INLINE void add(const Term& term, Reduced& out) {
    out.own += term.J_depth * term.J_depth;
    out.pull += term.J_depth * term.r[2];
    if (term.free < 0) return;
    Line* block = &out.own_blocks[6 * term.free];
    for (int k = 0; k < 3; ++k) {
        out.b[term.free].row += term.J_pose[k] * term.r[k];
        for (int r = 0; r < 6; ++r) block[r].row += term.J_pose[k] * term.J_pose[k][r];
    }
    out.across[term.free].row += term.J_pose[2] * term.J_depth;
}

// Adds what n terms of landmark l, whose first is observation `begin`, leave of it when it is eliminated.
SEAMARK_INLINE void eliminate(int64_t l, int64_t begin, int64_t n, int64_t n_free, double damping, Reduced& out) {
    double H[9] = {};
    double *b = &out.b_landmark[3 * l], *by_depth = &out.W_depth[3 * l], *inverse = &out.inverse[9 * l];
    const Term* terms = out.terms.data();
    const Cross* W = &out.W[begin];
    for (int j = 0; j < 3; ++j) b[j] = by_depth[j] = 0;
    for (int64_t i = 0; i < n; ++i) {
        const Term& term = terms[i];
        for (int a = 0; a < 3; ++a) {
            for (int k = 0; k < 3; ++k) {
                b[a] += term.J_landmark[k][a] * term.r[k];
                for (int c = 0; c < 3; ++c) H[3 * a + c] += term.J_landmark[k][a] * term.J_landmark[k][c];
            }
            by_depth[a] += term.J_depth * term.J_landmark[2][a];
        }
    }
    for (int a = 0; a < 3; ++a) H[4 * a] = H[4 * a] * (1 + damping) + kHold;
    if (!invert3(H, inverse)) {
        out.solvable = false;
        std::fill(inverse, inverse + 9, std::numeric_limits<double>::infinity());
        return;
    }
    double back[3];
    for (int a = 0; a < 3; ++a)
        back[a] = inverse[3 * a] * by_depth[0] + inverse[3 * a + 1] * by_depth[1] + inverse[3 * a + 2] * by_depth[2];
    for (int a = 0; a < 3; ++a) out.own -= by_depth[a] * back[a], out.pull -= back[a] * b[a];
    for (int64_t i = 0; i < n; ++i) {
        const int64_t f = terms[i].free;
        if (f < 0) continue;
        Row WH[3], of_b, of_depth;
        for (int a = 0; a < 3; ++a) times(W[i].row, inverse + 3 * a, WH[a]);
        times(WH, b, of_b);
        times(WH, by_depth, of_depth);
        out.b[f].row -= of_b;
        out.across[f].row -= of_depth;
        for (int64_t k = 0; k < n; ++k) {
            const int64_t g = terms[k].free;
            if (g < f) continue;
            Line* block = &out.blocks[6 * (f * n_free + g)];
            const Row* across = W[k].row;
            for (int r = 0; r < 6; ++r) block[r].row -= across[0] * WH[0][r] + across[1] * WH[1][r] + across[2] * WH[2][r];
        }
    }
}

// Each landmark is linearised and eliminated while its observations are in the nearest cache.
SEAMARK_CLONES void reduce(const Bundle& bundle, const Adjusted& state, double damping, Reduced& out) {
    const int64_t n_free = bundle.n_poses - bundle.n_fixed;
    for (std::vector<Line>* lines : {&out.blocks, &out.own_blocks, &out.b, &out.across})
        std::fill(lines->begin(), lines->end(), Line{});
    out.own = bundle.offset_information;
    out.pull = bundle.offset_information * (state.offset - bundle.offset);
    out.solvable = true;
    for (int64_t begin = 0, end; begin < bundle.seen.n; begin = end) {
        const int64_t l = bundle.landmark_of[begin];
        for (end = begin; end < bundle.seen.n && bundle.landmark_of[end] == l; ++end) {
            if (static_cast<size_t>(end - begin) == out.terms.size()) out.terms.emplace_back();
            Term& term = out.terms[end - begin];
            linearise(bundle, state, end, term, out.W[end]);
            add(term, out);
        }
        eliminate(l, begin, end - begin, n_free, damping, out);
    }
    for (int64_t f = 0; f < n_free; ++f)
        for (int r = 0; r < 6; ++r) {
            Line& own = out.own_blocks[6 * f + r];
            own.row[r] *= 1 + damping;
            out.blocks[6 * (f * n_free + f) + r].row += own.row;
        }
}

// Writes the matrix of the free poses, with the offset as the last row and column if wanted.
int dense(const Reduced& from, int64_t n_free, bool with_offset, std::vector<double>& out) {
    const int poses = static_cast<int>(6 * n_free), size = poses + (with_offset ? 1 : 0);
    out.resize(static_cast<size_t>(size) * size);
    for (int i = 0; i < poses; ++i)
        for (int j = i; j < poses; ++j)
            out[i * size + j] = out[j * size + i] = from.blocks[6 * ((i / 6) * n_free + j / 6) + i % 6].row[j % 6];
    if (with_offset) {
        for (int i = 0; i < poses; ++i) out[i * size + poses] = out[poses * size + i] = from.across[i / 6].row[i % 6];
        out[poses * size + poses] = from.own;
    }
    for (int i = 0; i < size; ++i) out[i * size + i] += kHold;
    return size;
}

SEAMARK_CLONES bool solve_dense(std::vector<double>& matrix, int size, double* b) {
    return solve(matrix.data(), size, size, b);
}

// Moves `to` one step from `from`; returns false when something is not determined.
bool step(const Bundle& bundle, const Reduced& reduced, const Adjusted& from, std::vector<double>& matrix, std::vector<double>& delta, Adjusted& to) {
    const int64_t n_free = bundle.n_poses - bundle.n_fixed;
    const int size = dense(reduced, n_free, true, matrix);
    delta.resize(size);
    for (int i = 0; i + 1 < size; ++i) delta[i] = -reduced.b[i / 6].row[i % 6];
    delta[size - 1] = -reduced.pull;
    if (!reduced.solvable || !solve_dense(matrix, size, delta.data())) return false;
    to.poses = from.poses;
    to.landmarks = from.landmarks;
    to.offset = from.offset + delta[size - 1];
    for (int64_t f = 0; f < n_free; ++f) retract(to.poses.data() + 16 * (bundle.n_fixed + f), &delta[6 * f]);
    for (int64_t begin = 0, end; begin < bundle.seen.n; begin = end) {
        const int64_t l = bundle.landmark_of[begin];
        double reaction[3];
        for (int a = 0; a < 3; ++a)
            reaction[a] = reduced.b_landmark[3 * l + a] + reduced.W_depth[3 * l + a] * delta[size - 1];
        for (end = begin; end < bundle.seen.n && bundle.landmark_of[end] == l; ++end) {
            const int64_t f = bundle.keyframe_of[end] - bundle.n_fixed;
            if (f < 0) continue;
            for (int a = 0; a < 3; ++a)
                for (int r = 0; r < 6; ++r) reaction[a] += reduced.W[end].row[a][r] * delta[6 * f + r];
        }
        const double* inverse = &reduced.inverse[9 * l];
        for (int a = 0; a < 3; ++a)
            to.landmarks[3 * l + a] -=
                inverse[3 * a] * reaction[0] + inverse[3 * a + 1] * reaction[1] + inverse[3 * a + 2] * reaction[2];
    }
    return true;
}

// What the observations say about the offset when poses and landmarks are unknown.
double information(const Bundle& bundle, const Reduced& reduced, std::vector<double>& matrix) {
    const int64_t n_free = bundle.n_poses - bundle.n_fixed;
    const int size = dense(reduced, n_free, false, matrix);
    std::vector<double> across(size);
    for (int i = 0; i < size; ++i) across[i] = reduced.across[i / 6].row[i % 6];
    if (!reduced.solvable || !solve_dense(matrix, size, across.data())) return 0;
    double left = reduced.own - bundle.offset_information;
    for (int i = 0; i < size; ++i) left -= reduced.across[i / 6].row[i % 6] * across[i];
    return std::max(0.0, left);
}

}  // namespace

void adjust(const Bundle& bundle, int iterations, double damping, double least_decrease, Adjusted& state) {
    const size_t n = bundle.seen.n, n_free = bundle.n_poses - bundle.n_fixed, n_landmarks = bundle.n_landmarks;
    Fit current{std::vector<double>(n), 0}, trial{std::vector<double>(n), 0};
    Reduced reduced;
    reduced.blocks.resize(6 * n_free * n_free), reduced.own_blocks.resize(6 * n_free);
    reduced.b.resize(n_free), reduced.across.resize(n_free);
    reduced.inverse.resize(9 * n_landmarks);
    reduced.b_landmark.resize(3 * n_landmarks), reduced.W_depth.resize(3 * n_landmarks);
    reduced.W.resize(n);
    std::vector<double> matrix, delta;
    Adjusted moved;
    evaluate(bundle, state, current);
    for (int iteration = 0; iteration < iterations; ++iteration) {
        reduce(bundle, state, damping, reduced);
        if (!step(bundle, reduced, state, matrix, delta, moved)) {
            damping *= 10;  // something that nothing determines: hold it more firmly
            continue;
        }
        evaluate(bundle, moved, trial);
        if (!(trial.cost < current.cost)) {
            damping *= 10;
            continue;
        }
        const double decrease = 1 - trial.cost / current.cost;
        std::swap(state, moved);
        std::swap(current, trial);
        damping *= 0.1;
        if (decrease < least_decrease) break;
    }
    reduce(bundle, state, 0, reduced);
    state.depth_information = information(bundle, reduced, matrix);
    state.covariances = std::move(reduced.inverse);
    state.errors = std::move(current.errors);
}

}  // namespace seamark
