// The kernels as plain functions for ctypes. Compiled once per history size and precision:
// -D HISTORY_SIZE=K [-D IN_FLOAT64 | -D PACKED_PAIRS], with -I to the folder of the (possibly mutated) sources.
#include "cuda_host_shim.h"

#include "two_loop.cuh"
#include "packed.cuh"

#include "lqn.cu"
#include "noise.cu"

#ifdef IN_FLOAT64
typedef double Real;
#else
typedef float Real;
#endif

extern "C" void run_lqn(unsigned block, const Real* positions, const Real* grads, Real* histories, Real* directions,
                        unsigned char* accepted, unsigned char* candidates, long long rows, Real min_cosine,
                        Real gamma_low, Real gamma_high, int powell, int graft, int clamp) {
  launch_on_host(block, rows, lqn_direction, positions, grads, histories, directions, accepted, candidates, rows,
                 min_cosine, gamma_low, gamma_high, powell, graft, clamp);
}

extern "C" void run_noise(unsigned block, Real* means, const Real* scales, const Real* quats, const Real* opacities,
                          const Real* eta, const float* lr, Real noise_scale, Real sharpness, Real threshold,
                          long long rows) {
  launch_on_host(block, rows, add_covariance_noise, means, scales, quats, opacities, eta, lr, noise_scale, sharpness,
                 threshold, rows);
}
