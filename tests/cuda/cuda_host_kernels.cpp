// The kernels as plain functions for ctypes. Compiled once per history size and precision:
// -D HISTORY_SIZE=K [-D IN_FLOAT64], with -I to the folder of the (possibly mutated) sources.
#include "cuda_host_shim.h"

#include "two_loop.cuh"

#include "histogram.cu"
#include "lqn.cu"
#include "own_frame.cu"
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

extern "C" void run_take_energy(unsigned block, const Real* energy, const unsigned char* valid, Real* state, Real* nu,
                                long long* counted, Real* sums, long long partitions, long long warmup,
                                long long memory, long long unlimited, Real limit, Real low, Real high, Real reach,
                                Real bandwidth, Real even, Real mean_abs, Real resolution, Real tiny) {
  launch_on_host(block, 1, take_energy, energy, valid, state, nu, counted, sums, partitions, warmup, memory,
                 unlimited, limit, low, high, reach, bandwidth, even, mean_abs, resolution, tiny);
}

extern "C" void run_own_frame_gradient(unsigned block, const Real* grads, const Real* quats, const Real* scales,
                                       Real* results, long long rows, Real min_aspect) {
  launch_on_host(block, rows, own_frame_gradient, grads, quats, scales, results, rows, min_aspect);
}

extern "C" void run_own_frame_displacement(unsigned block, const Real* steps, const Real* quats, const Real* scales,
                                           Real* results, long long rows, Real min_aspect) {
  launch_on_host(block, rows, own_frame_displacement, steps, quats, scales, results, rows, min_aspect);
}
