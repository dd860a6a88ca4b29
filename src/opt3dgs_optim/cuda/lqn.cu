// Per-point L-BFGS: store the new pair, then the direction. One thread per point. Compiled by NVRTC
// for one history size, -D HISTORY_SIZE=K; `two_loop.cuh` goes in front.
#if !defined(HISTORY_SIZE) || HISTORY_SIZE > 5
#error "HISTORY_SIZE, the number of pairs, must be 1 to 5: more do not fit into registers"
#endif

static constexpr int LANES = History<Real, HISTORY_SIZE>::lanes;

// A history in registers spills unless ptxas may take as many as it likes: the 1.
extern "C" __global__ void __launch_bounds__(128, 1)
    lqn_direction(const Real* __restrict__ positions, const Real* __restrict__ grads, Real* histories,
                  Real* __restrict__ directions, unsigned char* __restrict__ accepted,
                  unsigned char* __restrict__ candidates, long long rows, Real min_cosine, int graft) {
  const long long row = static_cast<long long>(blockIdx.x) * blockDim.x + threadIdx.x;
  if (row >= rows) return;
  Vec3<Real> fed;
  const Flags flags = lqn_point<HISTORY_SIZE>(read_row(positions, row), read_row(grads, row), histories + LANES * row,
                                              min_cosine, graft != 0, &fed);
  write_row(directions, row, fed);
  accepted[row] = flags.accepted;
  candidates[row] = flags.candidate;
}
