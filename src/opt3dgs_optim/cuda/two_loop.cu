// The two-loop recursion alone, on histories that stay as they are. One thread per point. Compiled by NVRTC
// for one history size, -D HISTORY_SIZE=K; `two_loop.cuh` goes in front.
#if !defined(HISTORY_SIZE) || HISTORY_SIZE > 5
#error "HISTORY_SIZE, the number of pairs, must be 1 to 5: more do not fit into registers"
#endif

// grads, results: [rows, 3]; histories: [rows, slots, 8].
extern "C" __global__ void __launch_bounds__(128, 1)
    two_loop(const Real* __restrict__ grads, const Real* __restrict__ histories, Real* __restrict__ results,
             long long rows) {
  const long long row = static_cast<long long>(blockIdx.x) * blockDim.x + threadIdx.x;
  if (row >= rows) return;
  constexpr int lanes = History<Real, HISTORY_SIZE>::lanes;
  write_row(results, row, two_loop_point<HISTORY_SIZE>(read_row(grads, row), histories + lanes * row));
}
