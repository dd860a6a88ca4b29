// The kernels as plain functions for ctypes. Compiled once per history size and precision:
// -D HISTORY_SIZE=K [-D IN_FLOAT64], with -I to the folder of the sources.
#include "cuda_host_shim.h"

#include "two_loop.cuh"

#include "lqn.cu"
#include "two_loop.cu"

extern "C" void run_lqn_direction(unsigned block, const Real* positions, const Real* grads, Real* histories, Real* directions,
                                  unsigned char* accepted, unsigned char* candidates, long long rows,
                                  Real min_cosine, int graft) {
  launch_on_host(block, rows, lqn_direction, positions, grads, histories, directions, accepted, candidates, rows,
                 min_cosine, graft);
}

extern "C" void run_two_loop(unsigned block, const Real* grads, const Real* histories, Real* results, long long rows) {
  launch_on_host(block, rows, two_loop, grads, histories, results, rows);
}
