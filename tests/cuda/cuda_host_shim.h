// Lets a host compiler run the package's unchanged .cu files: every thread of the grid, in turn.
#pragma once
#include <cmath>

#define __host__
#define __device__
#define __global__
#define __forceinline__ inline
#define __launch_bounds__(...)
#ifndef __restrict__
#define __restrict__ __restrict
#endif

using std::fabs;
using std::isfinite;
using std::sqrt;

struct HostIndex { unsigned x = 0; };
static HostIndex blockIdx, blockDim, threadIdx;

// The launch that opt3dgs_optim/cuda/__init__.py makes: enough blocks of `block` threads.
template <typename Kernel, typename... Arguments>
void launch_on_host(unsigned block, long long rows, Kernel kernel, Arguments... arguments) {
  blockDim.x = block;
  const long long blocks = (rows + block - 1) / block;
  for (long long b = 0; b < blocks; ++b) {
    for (unsigned t = 0; t < block; ++t) {
      blockIdx.x = static_cast<unsigned>(b);
      threadIdx.x = t;
      kernel(arguments...);
    }
  }
}
