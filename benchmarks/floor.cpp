// The simplified Newton of nhjax by hand: Lobatto IIIA-B with s = 3 stages and the
// symmetric closure, for the chaotic system with n = 7 and its one constraint.
//
//     floor LANES STEPS H REPEATS INPUT OUTPUT
//
// reads q and v of any number of trajectories, integrates each over STEPS steps,
// REPEATS times, and prints the seconds that each time took. LANES = 1 takes one
// trajectory after the other, 2, 4 or 8 as many at once, one in each lane of a vector.
// OUTPUT gets q, v and p of each at the end, the number of iterations, and for each step
// that of the trajectory that needed most.

#include <algorithm>
#include <chrono>
#include <cmath>
#include <cstddef>
#include <cstdint>
#include <cstdio>
#include <cstdlib>
#include <cstring>
#include <limits>
#include <vector>

constexpr int M = 3, N = 2 * M + 1, S = 3, MAX_ITERATIONS = 100;
constexpr double A[S][S] = {
    {0, 0, 0}, {5. / 24, 1. / 3, -1. / 24}, {1. / 6, 2. / 3, 1. / 6}};
constexpr double A_HAT[S][S] = {
    {1. / 6, -1. / 6, 0}, {1. / 6, 1. / 3, 0}, {1. / 6, 5. / 6, 0}};
constexpr double EPS = std::numeric_limits<double>::epsilon();
constexpr double GROWTH = 2;
constexpr double NOISIEST = 400 * EPS;

// The two number types: a double, and a vector with a trajectory in each lane.

inline double absolute(double x) { return std::fabs(x); }
inline double larger(double x, double y) { return x > y ? x : y; }
inline double smaller(double x, double y) { return x < y ? x : y; }
inline bool any(bool mask) { return mask; }

template <int W>
struct Pack {
    typedef double type __attribute__((vector_size(8 * W)));
    typedef std::int64_t mask __attribute__((vector_size(8 * W)));
};

template <int W>
using Vec = typename Pack<W>::type;

template <class T>
struct Lanes {
    static constexpr int count = sizeof(T) / sizeof(double);
    using mask = typename Pack<count>::mask;
};
template <>
struct Lanes<double> {
    static constexpr int count = 1;
    using mask = bool;
};
template <class T>
using Mask = typename Lanes<T>::mask;

template <class T>
inline T absolute(T x) {
    return (T)((Mask<T>)x & std::numeric_limits<std::int64_t>::max());
}
template <class T>
inline T larger(T x, T y) {
    return x > y ? x : y;
}
template <class T>
inline T smaller(T x, T y) {
    return x < y ? x : y;
}
template <class M>
inline bool any(M mask) {
    std::int64_t lanes[sizeof(M) / 8], every = 0;
    std::memcpy(lanes, &mask, sizeof(M));
    for (std::int64_t lane : lanes) every |= lane;
    return every != 0;
}
template <class T>
inline double lane(const T& x, int i) {
    double values[Lanes<T>::count];
    std::memcpy(values, &x, sizeof(T));
    return values[i];
}
template <class T>
inline void set_lane(T& x, int i, double value) {
    std::memcpy(reinterpret_cast<char*>(&x) + 8 * i, &value, 8);
}

template <class T>
struct Vector {
    T x[N];
    T& operator[](int k) { return x[k]; }
    const T& operator[](int k) const { return x[k]; }
};

#define EACH(k) for (int k = 0; k < N; ++k)

// Σ_j row_j x_j, without the terms that are zero.
template <class T>
inline T combined(const double (&row)[S], const Vector<T> (&x)[S], int k) {
    T sum = row[0] * x[0][k] + row[1] * x[1][k];
    return row[2] == 0 ? sum : sum + row[2] * x[2][k];
}

// f = D1L.
template <class T>
inline void free_force(const Vector<T>& q, Vector<T>& f) {
    f[0] = -q[0];
    for (int i = 1; i <= M; ++i) {
        f[i] = -q[i] * (1. + q[M + i] * q[M + i]);
        f[M + i] = -q[M + i] * (1. + q[i] * q[i]);
    }
    f[M + 1] -= q[M + 1] * q[M + 2] * q[M + 2];
    f[M + 2] -= q[M + 2] * q[M + 1] * q[M + 1];
}

// B x with B = D2Φ = (1, 0..0, q_{m+2}..q_n), and so Φ for x = v.
template <class T>
inline T constraint(const Vector<T>& q, const Vector<T>& x) {
    T sum = x[0];
    for (int k = M + 1; k < N; ++k) sum += q[k] * x[k];
    return sum;
}

// f + Bᵀ λ.
template <class T>
inline void add_reaction(const Vector<T>& q, T lambda, Vector<T>& f) {
    f[0] += lambda;
    for (int k = M + 1; k < N; ++k) f[k] += lambda * q[k];
}

// B Bᵀ at two positions; the mass matrix is 1.
template <class T>
inline T compliance(const Vector<T>& q, const Vector<T>& r) {
    T sum = q[M + 1] * r[M + 1];
    for (int k = M + 2; k < N; ++k) sum += q[k] * r[k];
    return 1. + sum;
}

// D1Φ v, the part of dΦ/dt without the acceleration.
template <class T>
inline T constraint_rate(const Vector<T>& v) {
    T sum = v[M + 1] * v[M + 1];
    for (int k = M + 2; k < N; ++k) sum += v[k] * v[k];
    return sum;
}

template <class T>
inline void two_sum(T& total, T& error, T increment) {
    T a = total, b = increment + error;
    total = a + b;
    T b_in_total = total - a;
    error = (a - (total - b_in_total)) + (b - b_in_total);
}

template <class T>
struct State {
    Vector<T> q, q_error, v, p, p_error;
    Vector<T> force, acceleration;  // at q, and at (q, v)
    T lambda;

    // What is known at a node: the free force, the acceleration and λ_c.
    void linearise() {
        free_force(q, force);
        T hidden = -constraint_rate(v) - constraint(q, force);
        lambda = hidden / compliance(q, q);
        acceleration = force;
        add_reaction(q, lambda, acceleration);
    }
};

// One step; returns the number of iterations of each lane.
template <class T>
inline T step(State<T>& y, double h) {
    // Starting values, to first order in h.
    Vector<T> H[S], u[S - 1];
    EACH(k) {
        T push = h * y.acceleration[k];
        H[0][k] = y.v[k];
        H[1][k] = y.v[k] + .5 * push;
        H[2][k] = y.v[k] + push;
        u[0][k] = y.v[k] + .5 * push;
        u[1][k] = y.v[k] + push;
    }
    T nu = y.lambda * 0., middle = y.lambda, end = y.lambda;
    Vector<T> a_end = y.acceleration;

    // The leading structure: B at the nodes, foreseen, and the Schur complement.
    Vector<T> q[S], B[S];
    q[0] = y.q;
    for (int i = 1; i < S; ++i) EACH(k) q[i][k] = y.q[k] + h * combined(A[i], H, k);
    for (int i = 0; i < S; ++i) B[i] = q[i];
    T schur[2][2];
    for (int i = 1; i < S; ++i) {
        T c[S];
        for (int j = 0; j < S; ++j) c[j] = A[i][j] * compliance(B[i], B[j]);
        schur[i - 1][0] = c[0] - c[2];  // Λ^1 = λ_k + ν, Λ^3 = λ_{k+1} - ν
        schur[i - 1][1] = c[1];
    }
    T inv_det = 1. / (schur[0][0] * schur[1][1] - schur[0][1] * schur[1][0]);
    T inv_c = 1. / compliance(B[2], B[2]);

    // The size of velocities and of what is rounded in them, and of B.
    T size_b = larger(T(y.lambda * 0. + 1.), absolute(y.q[M + 1]));
    T rate = absolute(y.acceleration[0]);
    for (int k = M + 2; k < N; ++k) size_b = larger(size_b, absolute(y.q[k]));
    for (int k = 1; k < N; ++k) rate = larger(rate, absolute(y.acceleration[k]));
    T scale = h * (rate + absolute(y.lambda) * size_b), size_v = absolute(H[0][0]);
    for (int i = 0; i < S; ++i) EACH(k) size_v = larger(size_v, absolute(H[i][k]));
    scale += size_v;  // the starting values at the nodes are among those of the stages

    Vector<T> f[S];  // free forces at the stages; that of the first never changes
    f[0] = y.force;
    free_force(q[2], f[2]);

    Vector<T> q_increment, p_increment, v_next;
    T iterations = y.lambda * 0., believed = iterations + 15 * EPS;
    T smallest = iterations + std::numeric_limits<double>::infinity();
    Mask<T> running = iterations == 0.;
    for (int sweep = 0; sweep < MAX_ITERATIONS; ++sweep) {
        // Forces at the stages, then stage and node velocities.
        free_force(q[1], f[1]);
        Vector<T> F[S] = {f[0], f[1], f[2]};
        add_reaction(y.q, T(y.lambda + nu), F[0]);
        add_reaction(q[1], middle, F[1]);
        add_reaction(q[2], T(end - nu), F[2]);
        T change = y.lambda * 0.;
        Vector<T> H_next[S], u_next[S - 1], p_change;
        for (int i = 0; i < S; ++i)
            EACH(k) H_next[i][k] = y.p[k] + h * combined(A_HAT[i], F, k);
        EACH(k) p_change[k] = h * combined(A[2], F, k);
        EACH(k) u_next[0][k] = y.p[k] + h * combined(A[1], F, k);
        EACH(k) u_next[1][k] = y.p[k] + p_change[k];

        // The constraints at the nodes, and the multipliers that make them hold.
        T phi[S - 1];
        for (int i = 1; i < S; ++i) {
            EACH(k) q[i][k] = y.q[k] + h * combined(A[i], H_next, k);
            phi[i - 1] = constraint(q[i], u_next[i - 1]);
        }
        T h_nu = (schur[0][1] * phi[1] - schur[1][1] * phi[0]) * inv_det;
        T h_middle = (schur[1][0] * phi[0] - schur[0][0] * phi[1]) * inv_det;
        Vector<T> push[S];
        EACH(k) {
            if (k == 0 || k > M) {
                push[0][k] = k ? B[0][k] * h_nu : h_nu;
                push[1][k] = k ? B[1][k] * h_middle : h_middle;
                push[2][k] = k ? -(B[2][k] * h_nu) : -h_nu;
                for (int i = 0; i < S; ++i) H_next[i][k] += combined(A_HAT[i], push, k);
                for (int i = 1; i < S; ++i) u_next[i - 1][k] += combined(A[i], push, k);
            }
        }
        T d_nu = h_nu / h, d_middle = h_middle / h;

        // The equations of motion at the end, for λ_c there.
        Vector<T> q_change;
        EACH(k) {
            q_change[k] = h * combined(A[2], H_next, k);
            q[1][k] = y.q[k] + h * combined(A[1], H_next, k);
            q[2][k] = y.q[k] + q_change[k];
        }
        free_force(q[2], f[2]);
        Vector<T> free = f[2];
        add_reaction(q[2], end, free);
        EACH(k) free[k] -= a_end[k];
        T hidden = constraint_rate(u_next[1]) + constraint(q[2], a_end);
        T d_end = -(hidden + constraint(B[2], free)) * inv_c;
        EACH(k) a_end[k] += free[k];
        add_reaction(B[2], d_end, a_end);

        // The multipliers move along by z = (1/2, -1/4, 1/2) of it, for which A z = 0 at
        // the nodes, and Â z = (1/8, 0, -1/8) and b Â z = 0 at the stages.
        d_nu += .5 * d_end;
        d_middle -= .25 * d_end;
        Vector<T> at_end;
        EACH(k) at_end[k] = y.lambda * 0.;
        add_reaction(B[2], T(.125 * h * d_end), at_end);
        EACH(k) {
            if (k == 0 || k > M) {
                H_next[0][k] += at_end[k];
                H_next[2][k] -= at_end[k];
                q[1][k] += h * (A[1][0] - A[1][2]) * at_end[k];
            }
        }

        // The size of the increment, and whether to stop.
        for (int i = 0; i < S; ++i)
            EACH(k) change = larger(change, absolute(T(H_next[i][k] - H[i][k])));
        for (int i = 0; i < S - 1; ++i)
            EACH(k) change = larger(change, absolute(T(u_next[i][k] - u[i][k])));
        T d_lambda = larger(absolute(d_nu), absolute(d_middle));
        d_lambda = larger(d_lambda, absolute(T(d_end - d_nu)));
        T size = larger(change, T(h * d_lambda * size_b));
        T first = sweep == 0 ? size : size * 0.;
        size /= scale;
        scale = larger(scale, first);
        for (int i = 0; i < S; ++i) H[i] = H_next[i];
        for (int i = 0; i < S - 1; ++i) u[i] = u_next[i];
        nu += d_nu;
        middle += d_middle;
        end += d_end;

        Mask<T> stalls = size >= smallest;
        believed = stalls ? smaller(T(believed * GROWTH), T(believed * 0. + NOISIEST))
                          : believed;
        Mask<T> stop = (size <= EPS) | (stalls & (size <= believed));
        smallest = smaller(size, smallest);
        iterations = running ? iterations + 1. : iterations;
        // A lane's outcome is that of the iterate at which it stops; what its iterates
        // do while others go on is of no consequence.
        Mask<T> ends = running & stop;
        if (any(ends)) {
            EACH(k) {
                q_increment[k] = ends ? q_change[k] : q_increment[k];
                p_increment[k] = ends ? p_change[k] : p_increment[k];
                v_next[k] = ends ? u[1][k] : v_next[k];
            }
            running = running & (ends == 0);
            if (!any(running)) break;
        }
    }
    if (any(running)) {
        std::fprintf(stderr, "A step did not converge.\n");
        std::exit(1);
    }
    EACH(k) two_sum(y.q[k], y.q_error[k], q_increment[k]);
    EACH(k) two_sum(y.p[k], y.p_error[k], p_increment[k]);
    y.v = v_next;
    y.linearise();
    return iterations;
}

template <class T>
double run(const std::vector<double>& input, std::vector<double>& output, int steps,
           double h) {
    constexpr int W = Lanes<T>::count;
    const int members = input.size() / (2 * N);
    double* most = output.data() + members * (3 * N + 1);
    std::fill(most, most + steps, 0.);
    const auto start = std::chrono::steady_clock::now();
    for (int first = 0; first < members; first += W) {
        State<T> y;
        for (int i = 0; i < W; ++i) {
            // Lanes beyond the last trajectory repeat it.
            const double* row = &input[2 * N * std::min(first + i, members - 1)];
            EACH(k) {
                set_lane(y.q[k], i, row[k]);
                set_lane(y.v[k], i, row[N + k]);
            }
        }
        y.p = y.v;
        EACH(k) y.q_error[k] = y.p_error[k] = y.v[k] * 0.;
        y.linearise();
        T total = y.lambda * 0.;
        for (int n = 0; n < steps; ++n) {
            T iterations = step(y, h);
            total += iterations;
            for (int i = 0; i < W; ++i) most[n] = larger(most[n], lane(iterations, i));
        }
        for (int i = 0; i < std::min(W, members - first); ++i) {
            double* row = &output[(3 * N + 1) * (first + i)];
            EACH(k) {
                row[k] = lane(y.q[k], i);
                row[N + k] = lane(y.v[k], i);
                row[2 * N + k] = lane(y.p[k], i);
            }
            row[3 * N] = lane(total, i);
        }
    }
    const std::chrono::duration<double> taken =
        std::chrono::steady_clock::now() - start;
    return taken.count();
}

int main(int argc, char** argv) {
    if (argc != 7) return 2;
    const int lanes = std::atoi(argv[1]), steps = std::atoi(argv[2]);
    const double h = std::atof(argv[3]);
    const int repeats = std::atoi(argv[4]);
    std::vector<double> input;
    std::FILE* file = std::fopen(argv[5], "rb");
    if (!file) return 2;
    double row[2 * N];
    while (std::fread(row, sizeof(row), 1, file) == 1)
        input.insert(input.end(), row, row + 2 * N);
    std::fclose(file);
    std::vector<double> output(input.size() / (2 * N) * (3 * N + 1) + steps);
    for (int k = 0; k < repeats; ++k) {
        double seconds = 0;
        switch (lanes) {
            case 1: seconds = run<double>(input, output, steps, h); break;
            case 2: seconds = run<Vec<2>>(input, output, steps, h); break;
            case 4: seconds = run<Vec<4>>(input, output, steps, h); break;
            case 8: seconds = run<Vec<8>>(input, output, steps, h); break;
            default: return 2;
        }
        std::printf("%.9e\n", seconds);
    }
    file = std::fopen(argv[6], "wb");
    if (!file) return 2;
    std::fwrite(output.data(), sizeof(double), output.size(), file);
    std::fclose(file);
    return 0;
}
