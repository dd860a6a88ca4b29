// The arithmetic of one point, for the GPU and, through tests/cuda/cuda_host_shim.h, for a host compiler.
// No includes, no barriers, no shared memory, no atomics: one thread, one point.
// The same formulas in the same order as in opt3dgs_optim/lbfgs.

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

// The largest power of two in a size; 0 of one that has not all of its digits.
POINT float power_of_two(float size) {
  union { float number; unsigned int bits; } value = {size};
  value.bits &= 0x7F800000u;
  return value.number;
}
POINT double power_of_two(double size) {
  union { double number; unsigned long long bits; } value = {size};
  value.bits &= 0x7FF0000000000000ull;
  return value.number;
}

// Euclidean norm without overflow or underflow; NaN of a zero vector.
template <typename T> POINT T length(Vec3<T> a) {
  const T size = largest(a);
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

// Divide a pair by sqrt(s.y).
template <typename T> POINT Pair<T> normalised(Vec3<T> s, Vec3<T> y) {
  const T of_s = length(s), of_y = length(y);
  s = over(s, of_s);
  y = over(y, of_y);
  const T cosine = dot(s, y);
  return {times(s, sqrt(of_s / of_y / cosine)), times(y, sqrt(of_y / of_s / cosine)), cosine};
}

// The history of one point, [slots][8]: see opt3dgs_optim/lbfgs/history.py for the layout. K, at most 5,
// is known to the compiler, so that all of it lives in registers from load to store.
template <typename T, int K> struct History {
  static constexpr int slots = K > 3 ? K : K + 1;
  static constexpr int lanes = 8 * slots;

  Lanes<T> s[slots], y[slots];
  Vec3<T> position, gradient;  // of the last visible step
  T steps;                     // in which the point was visible

  // `row` is the point's row of the history tensor; it has to begin at a multiple of 16 bytes.
  POINT explicit History(const T* row) {
#pragma unroll
    for (int j = 0; j < slots; ++j) {
      s[j] = load(row + 8 * j);
      y[j] = load(row + 8 * j + 4);
    }
    if constexpr (K > 3) {
      position = {s[0].spare, s[1].spare, s[2].spare};
      gradient = {y[0].spare, y[1].spare, y[2].spare};
      steps = s[3].spare;
    } else {
      position = s[K].v;
      gradient = y[K].v;
      steps = s[K].spare;
    }
  }

  // Put the pair in front, if it is accepted, and write pairs and header back to `row`.
  POINT void write(T* row, Pair<T> pair, bool accepted) {
    if (accepted) {
#pragma unroll
      for (int j = K - 1; j > 0; --j) {
        s[j].v = s[j - 1].v;
        y[j].v = y[j - 1].v;
      }
      s[0].v = pair.s;
      y[0].v = pair.y;
    }
    if constexpr (K > 3) {
      s[0].spare = position.x;
      s[1].spare = position.y;
      s[2].spare = position.z;
      y[0].spare = gradient.x;
      y[1].spare = gradient.y;
      y[2].spare = gradient.z;
      s[3].spare = steps;
    } else {
      s[K] = {position, steps};
      y[K] = {gradient, T(0)};
    }
#pragma unroll
    for (int j = 0; j < slots; ++j) {
      store(row + 8 * j, s[j]);
      store(row + 8 * j + 4, y[j]);
    }
  }
};

// Nocedal and Wright (2006), algorithm 7.4, for pairs with s.y = 1; an empty slot is zero.
template <int K, typename T> POINT Vec3<T> recursion(Vec3<T> q, const History<T, K>& history) {
  T alpha[K];
#pragma unroll
  for (int j = 0; j < K; ++j) {
    const Vec3<T> s = history.s[j].v, y = history.y[j].v;
    alpha[j] = dot(s, q);
    q = along(q, -alpha[j], y);
  }
  // s.y = 1, hence gamma = 1 / y.y of the newest pair. No pair: r stays the gradient.
  T inverse_gamma = dot(history.y[0].v, history.y[0].v);
  if (inverse_gamma <= T(0)) inverse_gamma = T(1);
  Vec3<T> r = over(q, inverse_gamma);
#pragma unroll
  for (int j = K - 1; j >= 0; --j) {
    const Vec3<T> s = history.s[j].v, y = history.y[j].v;
    r = along(r, alpha[j] - dot(y, r), s);
  }
  return r;
}

// H g of one point. Divided by the power of two in its largest component, the gradient keeps s.q in range.
template <int K, typename T> POINT Vec3<T> two_loop_point(Vec3<T> grad, const T* row) {
  const T size = power_of_two(largest(grad));
  const T scale = size == T(0) ? T(1) : size;
  return times(recursion(over(grad, scale), History<T, K>(row)), scale);
}

struct Flags { bool accepted, candidate; };

// One step of one point: accept a pair, update the header, and say what Adam is fed.
template <int K, typename T>
POINT Flags lqn_point(Vec3<T> position, Vec3<T> grad, T* row, T min_cosine, bool graft, Vec3<T>* fed) {
  *fed = grad;  // what every point without a usable result keeps, bit for bit
  const T size = largest(grad);
  if (!finite(grad) || size == T(0)) return {false, false};  // not visible: nothing changes
  History<T, K> history(row);
  const Pair<T> pair = normalised(along(position, T(-1), history.position), along(grad, T(-1), history.gradient));
  const bool candidate = history.steps > T(0);
  const bool accepted = candidate && pair.cosine > min_cosine;  // false where zero or not finite
  history.position = position;
  history.gradient = grad;
  history.steps += T(1);
  history.write(row, pair, accepted);

  const T scale = power_of_two(size);
  const Vec3<T> unit = over(grad, scale);
  Vec3<T> r = recursion(unit, history);
  if (graft) r = times(r, length(unit) / length(r));  // 1 without pairs
  r = times(r, scale);
  const T descent = dot(unit, r);
  if (descent > T(0) && isfinite(descent)) *fed = r;
  return {accepted, candidate};
}
