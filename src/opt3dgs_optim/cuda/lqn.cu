// Per-point L-BFGS step: store the new pair, then the two-loop direction. One thread per point.
// Compiled by NVRTC for one history size, -D HISTORY_SIZE=K; `two_loop.cuh` and `packed.cuh` go in
// front. With -D PACKED_PAIRS, the pairs are half-size ones.
#ifndef HISTORY_SIZE
#error "HISTORY_SIZE, the number of pairs, must be defined"
#endif
#if defined(PACKED_PAIRS) && defined(IN_FLOAT64)
#error "half-size pairs are for float32"
#endif

#ifdef PACKED_PAIRS
template <typename T> using Stored = PackedHistory<HISTORY_SIZE>;
#else
template <typename T> using Stored = History<T, HISTORY_SIZE>;
#endif

template <typename T>
POINT void lqn_row(const T* positions, const T* grads, T* histories, T* directions, unsigned char* accepted,
                   unsigned char* candidates, long long rows, Options<T> options) {
  const long long row = static_cast<long long>(blockIdx.x) * blockDim.x + threadIdx.x;
  if (row >= rows) return;
  const T* p = positions + 3 * row;
  const T* g = grads + 3 * row;
  Vec3<T> fed;
  const Flags flags =
      lqn_point<T, HISTORY_SIZE, Stored<T>>({p[0], p[1], p[2]}, {g[0], g[1], g[2]},
                                            histories + Stored<T>::lanes * row, options, &fed);
  T* out = directions + 3 * row;
  out[0] = fed.x;
  out[1] = fed.y;
  out[2] = fed.z;
  accepted[row] = flags.accepted;
  candidates[row] = flags.candidate;
}

// More blocks asked for per multiprocessor make ptxas use more registers here, up to spills.
#define LQN_KERNEL(NAME, T)                                                                              \
  extern "C" __global__ void __launch_bounds__(128)                                                      \
      NAME(const T* __restrict__ positions, const T* __restrict__ grads, T* histories,      \
           T* __restrict__ directions, unsigned char* __restrict__ accepted,                             \
           unsigned char* __restrict__ candidates, long long rows, T min_cosine, T gamma_low,            \
           T gamma_high, int powell, int graft, int clamp) {                                             \
    lqn_row<T>(positions, grads, histories, directions, accepted, candidates, rows,                      \
               {min_cosine, gamma_low, gamma_high, powell != 0, graft != 0, clamp != 0});                \
  }

#ifdef IN_FLOAT64
LQN_KERNEL(lqn_direction, double)
#else
LQN_KERNEL(lqn_direction, float)
#endif
