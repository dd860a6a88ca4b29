// Vectors into and out of each Gaussian's own frame B = R diag(s), one thread per Gaussian: R is the rotation of
// its quaternion, and s are its standard deviations. `two_loop.cuh` goes in front, for Real and its vectors.
// A deviation counts as no less than min_aspect of the Gaussian's longest.
// What is fed is bounded, so that Adam's second moment, the mean of its square, stays finite.
// quats: [rows, 4], wxyz, of any length, beginning at a multiple of 16 bytes; scales: [rows, 3], logarithms.

template <typename T> POINT Vec3<T> cross(Vec3<T> a, Vec3<T> b) {
  return {a.y * b.z - a.z * b.y, a.z * b.x - a.x * b.z, a.x * b.y - a.y * b.x};
}

template <typename T> POINT Vec3<T> product(Vec3<T> a, Vec3<T> b) { return {a.x * b.x, a.y * b.y, a.z * b.z}; }

template <typename T> POINT T larger(T a, T b) { return b > a ? b : a; }

// Half of the root of the largest number, a power of two.
POINT float largest(float) { return 0x1p63f; }
POINT double largest(double) { return 0x1p511; }

template <typename T> POINT T bounded(T x) {
  const T most = largest(x);
  return x > most ? most : x < -most ? -most : x;
}

template <typename T> struct Frame {
  T w;
  Vec3<T> axis;  // w and axis: the quaternion, of length 1
  Vec3<T> deviations;

  POINT Frame(const T* quats, const T* scales, long long row, T min_aspect) {
    const Lanes<T> q = load(quats + 4 * row);  // wxy, and z
    const Vec3<T> xyz = {q.v.y, q.v.z, q.spare};
    const T norm = sqrt(q.v.x * q.v.x + dot(xyz, xyz));
    const T size = norm > T(1e-12) ? norm : T(1e-12);  // as torch.nn.functional.normalize
    w = q.v.x / size;
    axis = over(xyz, size);
    const Vec3<T> log_scale = read_row(scales, row);
    const Vec3<T> s = {exp(log_scale.x), exp(log_scale.y), exp(log_scale.z)};
    const T longest = larger(larger(s.x, s.y), s.z), least = min_aspect * longest;
    deviations = {larger(s.x, least), larger(s.y, least), larger(s.z, least)};
    // What is not finite less itself is no zero. Such a Gaussian, or one without a finite size, counts
    // as a point: nothing moves it.
    const T total = norm + s.x + s.y + s.z;
    if (!(total - total == T(0)) || !(longest < largest(norm))) {
      w = T(0);
      axis = deviations = {T(0), T(0), T(0)};
    }
  }

  // v + w t + axis x t with t = 2 axis x v; with -w it is the inverse rotation.
  POINT Vec3<T> rotated(Vec3<T> v, T w) const {
    const Vec3<T> t = times(cross(axis, v), T(2));
    return along(along(v, w, t), T(1), cross(axis, t));
  }

  POINT Vec3<T> into(Vec3<T> v) const { return product(deviations, rotated(v, -w)); }  // B^T v
  POINT Vec3<T> out_of(Vec3<T> v) const { return rotated(product(deviations, v), w); }  // B v
};

POINT long long this_row() { return static_cast<long long>(blockIdx.x) * blockDim.x + threadIdx.x; }

// results = B^T grads, bounded
extern "C" __global__ void __launch_bounds__(128)
    own_frame_gradient(const Real* __restrict__ grads, const Real* __restrict__ quats,
                       const Real* __restrict__ scales, Real* __restrict__ results, long long rows, Real min_aspect) {
  const long long row = this_row();
  if (row >= rows) return;
  const Vec3<Real> own = Frame<Real>(quats, scales, row, min_aspect).into(read_row(grads, row));
  write_row(results, row, Vec3<Real>{bounded(own.x), bounded(own.y), bounded(own.z)});
}

// results = B steps
extern "C" __global__ void __launch_bounds__(128)
    own_frame_displacement(const Real* __restrict__ steps, const Real* __restrict__ quats,
                           const Real* __restrict__ scales, Real* __restrict__ results, long long rows,
                           Real min_aspect) {
  const long long row = this_row();
  if (row >= rows) return;
  write_row(results, row, Frame<Real>(quats, scales, row, min_aspect).out_of(read_row(steps, row)));
}
