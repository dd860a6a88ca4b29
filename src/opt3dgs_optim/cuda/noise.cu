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

extern "C" __global__ void __launch_bounds__(128)
    add_covariance_noise(Real* __restrict__ means, const Real* __restrict__ scales,
                         const Real* __restrict__ quats, const Real* __restrict__ opacities,
                         const Real* __restrict__ eta, const float* __restrict__ lr, Real noise_scale,
                         Real sharpness, Real threshold, long long rows) {
  const long long row = static_cast<long long>(blockIdx.x) * blockDim.x + threadIdx.x;
  if (row >= rows) return;
  const Vec3<Real> noise =
      covariance_noise(read_row(scales, row), load(quats + 4 * row), opacities[row], read_row(eta, row), sharpness, threshold);
  // The learning rate is read here and now: a captured graph sees what the scheduler has written.
  const Real factor = lr ? static_cast<Real>(*lr) * noise_scale : noise_scale;
  Real* m = means + 3 * row;
  m[0] += noise.x * factor;
  m[1] += noise.y * factor;
  m[2] += noise.z * factor;
}
