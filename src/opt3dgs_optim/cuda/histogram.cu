// The flat histogram's step: nu of one energy, and the update of the density, in one launch. How many
// energies have counted is known on the device only: one that is not finite does not. One
// thread: some fifty partitions, always summed in the same order. Formulas and constants are those of
// opt3dgs_optim.partitions.MovingPartitions. `two_loop.cuh` goes in front, for Real.

// As torch.lerp: exactly `to` at rate 1.
template <typename T> POINT T lerped(T from, T to, T rate) {
  return rate < T(0.5) ? from + rate * (to - from) : to - (to - from) * (T(1) - rate);
}

template <typename T> POINT T clamped(T x, T low, T high) { return x < low ? low : x > high ? high : x; }

// The Gaussian by which a visit at z is spread, over its value at z itself or, outside of the range,
// at the nearest end: it never vanishes everywhere.
template <typename T> struct Spread {
  T z, inside, half_width, reach, scale;

  POINT Spread(T at, T half_width, T reach, T bandwidth)
      : z(at), inside(clamped(at, half_width - reach, reach - half_width)), half_width(half_width), reach(reach),
        scale(T(1) / (T(2) * bandwidth * bandwidth)) {}

  POINT T center(int i) const { return T(2 * i + 1) * half_width - reach; }

  POINT T of(int i) const {  // -(c - z)^2, less that of `inside`, has no large terms to cancel
    return exp((inside - center(i)) * (center(i) + inside - T(2) * z) * scale);
  }
};

// state: [3 + partitions], the mean, mean absolute deviation and mean slope, and the density q.
// valid: null where the energy is known to be finite. One that is not changes nothing.
// counted: number of finite energies so far. sums: powers 0, 1 and 2 of nu, summed over those after
// the warm-up, in which nu is 1. memory: energies that all means remember. limit: of the distance in
// mean absolute deviations, but for the first `unlimited` energies.
extern "C" __global__ void __launch_bounds__(128)
    take_energy(const Real* __restrict__ energy, const unsigned char* __restrict__ valid, Real* state, Real* nu,
                long long* counted, Real* sums, long long partitions, long long warmup, long long memory,
                long long unlimited, Real limit, Real low, Real high, Real reach, Real bandwidth, Real even,
                Real mean_abs, Real resolution, Real tiny) {
  if (blockIdx.x > 0 || threadIdx.x > 0) return;
  const int count = static_cast<int>(partitions);
  Real* q = state + 3;
  const long long taken = *counted + 1;
  const Real mean = taken > 1 ? state[0] : *energy;
  const Real distance = *energy - mean;
  if (!isfinite(distance) || (valid && !*valid)) return;
  *counted = taken;
  const Real rate = Real(1) / Real(taken < memory ? taken : memory);
  const Real unit = state[1] + resolution * fabs(distance);
  const Real t = taken > unlimited ? clamped(distance / unit, -limit, limit) : distance / unit;
  const Spread<Real> spread(mean_abs * t, reach / Real(count), reach, bandwidth);

  Real total = 0, kq = 0, kq_slope = 0;  // sums of k, k q, and k q times the slope of log k
  for (int i = 0; i < count; ++i) {
    const Real k = spread.of(i), product = k * q[i];
    total += k;
    kq += product;
    kq_slope += product * (spread.center(i) - spread.z);
  }
  // Smoothing by k twice widens a Gaussian's variance to 1 + 2 h^2.
  const Real widened = spread.scale + Real(1);
  // Of the unlimited energies it has no bound, and would own its mean for long.
  const Real slope =
      taken > unlimited ? widened * (kq_slope / total) / (kq / total + even / Real(count)) : Real(0);
  const Real multiplier = taken > warmup ? clamped(slope - state[2] + Real(1), low, high) : Real(1);
  *nu = multiplier;
  if (taken > warmup) {
    sums[0] += Real(1);
    sums[1] += multiplier;
    sums[2] += multiplier * multiplier;
  }
  const Real step = t * unit;
  state[0] = lerped(mean, mean + step, rate);
  state[1] = lerped(state[1], hypot(step, tiny), rate);
  state[2] = lerped(state[2], slope, rate);
  for (int i = 0; i < count; ++i) q[i] = lerped(q[i], spread.of(i) / total, rate);
}
