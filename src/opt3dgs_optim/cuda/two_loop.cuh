// The arithmetic of one point, for the GPU and, through tests/cuda/cuda_host_shim.h, for a host compiler.
// No includes, no barriers, no shared memory, no atomics: one thread, one point.
// The same formulas in the same order as in opt3dgs_optim/lbfgs.
#pragma once

#define POINT __host__ __device__ __forceinline__

#ifdef IN_FLOAT64
typedef double Real;  // what the kernels are compiled for
#else
typedef float Real;
#endif

template <typename T> struct Vec3 { T x, y, z; };

template <typename T> POINT T dot(Vec3<T> a, Vec3<T> b) { return a.x * b.x + a.y * b.y + a.z * b.z; }

// a + t b
template <typename T> POINT Vec3<T> along(Vec3<T> a, T t, Vec3<T> b) {
  return {a.x + t * b.x, a.y + t * b.y, a.z + t * b.z};
}

template <typename T> POINT Vec3<T> times(Vec3<T> a, T t) { return {a.x * t, a.y * t, a.z * t}; }

template <typename T> POINT Vec3<T> over(Vec3<T> a, T t) { return {a.x / t, a.y / t, a.z / t}; }

template <typename T> POINT T largest(Vec3<T> a) {
  const T x = fabs(a.x), y = fabs(a.y), z = fabs(a.z);
  const T xy = x > y ? x : y;
  return xy > z ? xy : z;
}

template <typename T> POINT bool finite(Vec3<T> a) { return isfinite(a.x) && isfinite(a.y) && isfinite(a.z); }

// Euclidean norm without overflow or underflow; 1 for a zero vector.
template <typename T> POINT T length(Vec3<T> a) {
  const T size = largest(a);
  if (size == T(0)) return T(1);
  const Vec3<T> scaled = over(a, size);
  return size * sqrt(dot(scaled, scaled));
}

// 16 bytes: one vector load or store.
template <typename T> struct Quarter;
template <> struct alignas(16) Quarter<float> { float a, b, c, d; };
template <> struct alignas(16) Quarter<double> { double a, b; };

// Four lanes of a slot: s and a spare lane, or y and a spare lane.
template <typename T> struct Lanes { Vec3<T> v; T spare; };

POINT Lanes<float> load(const float* at) {
  const Quarter<float> q = *reinterpret_cast<const Quarter<float>*>(at);
  return {{q.a, q.b, q.c}, q.d};
}
POINT Lanes<double> load(const double* at) {
  const Quarter<double>* q = reinterpret_cast<const Quarter<double>*>(at);
  const Quarter<double> low = q[0], high = q[1];
  return {{low.a, low.b, high.a}, high.b};
}
POINT void store(float* at, Lanes<float> lanes) {
  *reinterpret_cast<Quarter<float>*>(at) = {lanes.v.x, lanes.v.y, lanes.v.z, lanes.spare};
}
POINT void store(double* at, Lanes<double> lanes) {
  Quarter<double>* q = reinterpret_cast<Quarter<double>*>(at);
  q[0] = {lanes.v.x, lanes.v.y};
  q[1] = {lanes.v.z, lanes.spare};
}

// Row `row` of [N, 3].
template <typename T> POINT Vec3<T> read_row(const T* rows, long long row) {
  const T* at = rows + 3 * row;
  return {at[0], at[1], at[2]};
}
template <typename T> POINT void write_row(T* rows, long long row, Vec3<T> v) {
  T* at = rows + 3 * row;
  at[0] = v.x;
  at[1] = v.y;
  at[2] = v.z;
}

template <typename T> struct Pair { Vec3<T> s, y; T cosine; };

// Divide a pair by |y|.
template <typename T> POINT Pair<T> normalised(Vec3<T> s, Vec3<T> y) {
  const T size = length(y);
  s = over(s, size);
  y = over(y, size);
  return {s, y, dot(over(s, length(s)), y)};
}

// Makes the compiler forget what memory holds. Without it, a long history that is read twice would
// be kept in registers between the two readings: 158 of them, or spills.
POINT void read_again() { asm volatile("" ::: "memory"); }

// The history of one point, [slots][8]: see opt3dgs_optim/lbfgs/history.py for the layout.
// K is known to the compiler, so that a short history lives in registers from load to store.
template <typename T, int K> struct History {
  static constexpr bool kept = K <= 5;  // more pairs than that are read again in the second loop
  static constexpr int slots = K > 3 ? K : K + 1;
  static constexpr int in_registers = kept ? K : 1;
  static constexpr int lanes = 8 * slots;

  T* row;
  Lanes<T> s[in_registers], y[in_registers];
  Vec3<T> position, gradient;  // of the last visible step
  T counter;                   // 0: never visible; c: holds c - 1 pairs

  POINT explicit History(T* at) : row(at) {
    if constexpr (K > 3) {
      if constexpr (kept) {
#pragma unroll
        for (int j = 0; j < K; ++j) {
          s[j] = load(row + 8 * j);
          y[j] = load(row + 8 * j + 4);
        }
        position = {s[0].spare, s[1].spare, s[2].spare};
        gradient = {y[0].spare, y[1].spare, y[2].spare};
        counter = s[3 % in_registers].spare;
      } else {
        position = {row[3], row[11], row[19]};
        gradient = {row[7], row[15], row[23]};
        counter = row[27];
      }
    } else {
#pragma unroll
      for (int j = 0; j < K; ++j) {
        s[j % in_registers] = load(row + 8 * j);
        y[j % in_registers] = load(row + 8 * j + 4);
      }
      const Lanes<T> first = load(row + 8 * K), second = load(row + 8 * K + 4);
      position = first.v;
      counter = first.spare;
      gradient = second.v;
    }
  }

  POINT Vec3<T> pair_s(int j) const {
    if constexpr (kept) return s[j].v;
    return load(row + 8 * j).v;
  }
  POINT Vec3<T> pair_y(int j) const {
    if constexpr (kept) return y[j].v;
    return load(row + 8 * j + 4).v;
  }

  // The spare lane of half `half` of slot `slot`, as the header has it now.
  POINT T spare(int slot, int half, T unused) const {
    if (K <= 3 || slot > 3 || (slot == 3 && half == 1)) return unused;
    if (slot == 3) return counter;
    const Vec3<T> v = half == 0 ? position : gradient;
    return slot == 0 ? v.x : slot == 1 ? v.y : v.z;
  }

  // Put the pair in front, if it is accepted, and write pairs and header back.
  POINT void write(Pair<T> pair, bool accepted) {
    if (accepted) {
#pragma unroll
      for (int j = K - 1; j >= 0; --j) {
        if constexpr (!kept) read_again();
        // The pair before the one that is being overwritten, newest first.
        Lanes<T> to_s, to_y;
        if constexpr (kept) {
          to_s = s[j];
          to_y = y[j];
          to_s.v = j > 0 ? s[j > 0 ? j - 1 : 0].v : pair.s;
          to_y.v = j > 0 ? y[j > 0 ? j - 1 : 0].v : pair.y;
          s[j] = to_s;
          y[j] = to_y;
        } else {
          to_s.v = j > 0 ? pair_s(j - 1) : pair.s;
          to_y.v = j > 0 ? pair_y(j - 1) : pair.y;
          to_s.spare = to_y.spare = T(0);
        }
        to_s.spare = spare(j, 0, to_s.spare);
        to_y.spare = spare(j, 1, to_y.spare);
        store(row + 8 * j, to_s);
        store(row + 8 * j + 4, to_y);
      }
    }
    if constexpr (K <= 3) {
      store(row + 8 * K, Lanes<T>{position, counter});
      store(row + 8 * K + 4, Lanes<T>{gradient, T(0)});
    } else if (!accepted) {
#pragma unroll
      for (int j = 0; j < 3; ++j) {
        row[8 * j + 3] = spare(j, 0, T(0));
        row[8 * j + 7] = spare(j, 1, T(0));
      }
      row[27] = counter;
    }
  }
};

// 1 / s.y, or 0 for an empty slot.
template <typename T> POINT T inverse(T sy) { return sy <= T(0) ? T(0) : T(1) / sy; }

// Nocedal and Wright (2006), algorithm 7.4, for pairs with |y| = 1; an empty slot is zero.
template <int K, typename T> POINT Vec3<T> recursion(Vec3<T> q, const History<T, K>& history) {
  T alpha[K];
#pragma unroll
  for (int j = 0; j < K; ++j) {
    if constexpr (!History<T, K>::kept) read_again();
    const Vec3<T> s = history.pair_s(j), y = history.pair_y(j);
    alpha[j] = dot(s, q) * inverse(dot(s, y));
    q = along(q, -alpha[j], y);
  }
  // |y| = 1, hence gamma = s.y / y.y = s.y of the newest pair. No pair: r stays the gradient.
  T gamma = dot(history.pair_s(0), history.pair_y(0));
  if (gamma <= T(0)) gamma = T(1);
  Vec3<T> r = times(q, gamma);
#pragma unroll
  for (int j = K - 1; j >= 0; --j) {
    if constexpr (!History<T, K>::kept) read_again();
    const Vec3<T> s = history.pair_s(j), y = history.pair_y(j);
    const T beta = dot(y, r) * inverse(dot(s, y));
    r = along(r, alpha[j] - beta, s);
  }
  return r;
}

struct Flags { bool accepted, candidate; };

// One step of one point: accept a pair, update the header, and say what Adam is fed.
template <int K, typename T>
POINT Flags lqn_point(Vec3<T> position, Vec3<T> grad, T* row, T min_cosine, bool graft, Vec3<T>* fed) {
  *fed = grad;  // what every point without a usable result keeps, bit for bit
  const T scale = largest(grad);
  if (!finite(grad) || scale == T(0)) return {false, false};  // not visible: nothing changes
  History<T, K> history(row);
  const Pair<T> pair = normalised(along(position, T(-1), history.position), along(grad, T(-1), history.gradient));
  const bool candidate = history.counter > T(0);
  const bool accepted = candidate && pair.cosine > min_cosine;  // false where not finite
  history.position = position;
  history.gradient = grad;
  if (!candidate) history.counter = T(1);
  if (accepted && history.counter < T(K + 1)) history.counter += T(1);
  history.write(pair, accepted);
  if (history.counter <= T(1)) return {accepted, candidate};

  const Vec3<T> unit = over(grad, scale);
  Vec3<T> r = recursion(unit, history);
  const T size = length(r);
  const bool descent = dot(unit, over(r, size)) > T(0);  // false where not finite
  if (graft) r = times(r, sqrt(dot(unit, unit)) / size);
  r = times(r, scale);
  if (descent && finite(r)) *fed = r;
  return {accepted, candidate};
}

// H g of one point; its gradient where it has no pair.
template <int K, typename T> POINT Vec3<T> two_loop_point(Vec3<T> grad, T* row) {
  const T scale = largest(grad);
  if (scale == T(0)) return grad;
  return times(recursion(over(grad, scale), History<T, K>(row)), scale);
}
