// 3DGS-MCMC's position noise (eq. 2), added in place. One thread per Gaussian.
// `two_loop.cuh` goes in front, for Vec3.

template <typename T> POINT T sigmoid(T x) { return T(1) / (T(1) + exp(-x)); }

template <typename T> POINT Vec3<T> cross(Vec3<T> a, Vec3<T> b) {
  return {a.y * b.z - a.z * b.y, a.z * b.x - a.x * b.z, a.x * b.y - a.y * b.x};
}

// Rotate v by the unit quaternion (w, q): v + w t + q x t with t = 2 q x v.
template <typename T> POINT Vec3<T> rotated(T w, Vec3<T> q, Vec3<T> v) {
  const Vec3<T> t = times(cross(q, v), T(2));
  return along(along(v, w, t), T(1), cross(q, t));
}

// sigmoid(-k (o - t)) Sigma eta, Sigma = R diag(s)^2 R^T, from log scales, wxyz and a logit.
template <typename T>
POINT Vec3<T> covariance_noise(Vec3<T> scales, Lanes<T> quat, T opacity, Vec3<T> eta, T sharpness, T threshold) {
  const T gate = sigmoid(-sharpness * (sigmoid(opacity) - threshold));
  const T w = quat.v.x;
  const Vec3<T> q = {quat.v.y, quat.v.z, quat.spare};
  T norm = sqrt(w * w + dot(q, q));
  norm = norm > T(1e-12) ? norm : T(1e-12);  // as torch.nn.functional.normalize
  const T real = w / norm;
  const Vec3<T> axis = over(q, norm);
  Vec3<T> v = rotated(real, times(axis, T(-1)), eta);  // R^T eta
  v = {v.x * exp(T(2) * scales.x), v.y * exp(T(2) * scales.y), v.z * exp(T(2) * scales.z)};
  return times(rotated(real, axis, v), gate);
}

template <typename T>
POINT void noise_row(T* means, const T* scales, const T* quats, const T* opacities, const T* eta, const float* lr,
                     T noise_scale, T sharpness, T threshold, long long rows) {
  const long long row = static_cast<long long>(blockIdx.x) * blockDim.x + threadIdx.x;
  if (row >= rows) return;
  const T* s = scales + 3 * row;
  const T* e = eta + 3 * row;
  const Vec3<T> noise = covariance_noise<T>({s[0], s[1], s[2]}, load(quats + 4 * row), opacities[row],
                                            {e[0], e[1], e[2]}, sharpness, threshold);
  // The learning rate is read here and now: a captured graph sees what the scheduler has written.
  const T factor = lr ? static_cast<T>(*lr) * noise_scale : noise_scale;
  T* m = means + 3 * row;
  m[0] += noise.x * factor;
  m[1] += noise.y * factor;
  m[2] += noise.z * factor;
}

#define NOISE_KERNEL(NAME, T)                                                                            \
  extern "C" __global__ void __launch_bounds__(128)                                                      \
      NAME(T* __restrict__ means, const T* __restrict__ scales, const T* __restrict__ quats,             \
           const T* __restrict__ opacities, const T* __restrict__ eta, const float* __restrict__ lr,     \
           T noise_scale, T sharpness, T threshold, long long rows) {                                    \
    noise_row<T>(means, scales, quats, opacities, eta, lr, noise_scale, sharpness, threshold, rows);     \
  }

#ifdef IN_FLOAT64
NOISE_KERNEL(add_covariance_noise, double)
#else
NOISE_KERNEL(add_covariance_noise, float)
#endif
