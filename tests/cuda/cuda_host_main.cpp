// The kernels as a program, for the sanitizers: every buffer is exactly as long as it has to be.
// Reads and writes float64: see tests/cuda/test_kernel_host.py, _write_input.
#include <cstdio>
#include <vector>

#include "cuda_host_kernels.cpp"

typedef std::vector<double> Buffer;

static Buffer take(FILE* file, size_t count) {
  Buffer buffer(count);
  if (count && fread(buffer.data(), sizeof(double), count, file) != count) throw "the input is too short";
  return buffer;
}

static void give(FILE* file, const Buffer& buffer) {
  if (!buffer.empty()) fwrite(buffer.data(), sizeof(double), buffer.size(), file);
}

int main(int, char** arguments) {
  FILE* in = fopen(arguments[1], "rb");
  FILE* out = fopen(arguments[2], "wb");
  const Buffer header = take(in, 2);
  const size_t rows = static_cast<size_t>(header[0]);
  const size_t row = 8 * History<double, HISTORY_SIZE>::slots;
  Buffer history(rows * row), direction(3 * rows);
  std::vector<unsigned char> accepted(rows), candidates(rows);
  for (int step = 0; step < header[1]; ++step) {
    const Buffer position = take(in, 3 * rows), grad = take(in, 3 * rows), reset = take(in, rows);
    for (size_t i = 0; i < rows * row; ++i) {
      if (reset[i / row] != 0) history[i] = 0;
    }
    const long long n = static_cast<long long>(rows);
    run_lqn_direction(128, position.data(), grad.data(), history.data(), direction.data(), accepted.data(),
                      candidates.data(), n, 1e-6, 1);
    give(out, direction);
    run_two_loop(128, grad.data(), history.data(), direction.data(), n);
    give(out, direction);
  }
  const Buffer quats = take(in, 4 * rows), scales = take(in, 3 * rows), grads = take(in, 3 * rows);
  Buffer turned(3 * rows), moved(3 * rows);
  const long long gaussians = static_cast<long long>(rows);
  run_own_frame_gradient(128, grads.data(), quats.data(), scales.data(), turned.data(), gaussians, Real(0.1));
  give(out, turned);
  run_own_frame_displacement(128, turned.data(), quats.data(), scales.data(), moved.data(), gaussians, Real(0.1));
  give(out, moved);
  const Buffer lengths = take(in, 2), sizes = take(in, 3), n = take(in, 9);
  Buffer state = take(in, static_cast<size_t>(lengths[1]) + 3), nu(1), sums(3);
  std::vector<long long> counted(1);
  for (int step = 0; step < lengths[0]; ++step) {
    const Buffer energy = take(in, 1), known = take(in, 1);
    const std::vector<unsigned char> valid(1, known[0] != 0);
    run_take_energy(128, energy.data(), known[0] > 1 ? nullptr : valid.data(), state.data(), nu.data(),
                    counted.data(), sums.data(), static_cast<long long>(lengths[1]),
                    static_cast<long long>(sizes[0]), static_cast<long long>(sizes[1]),
                    static_cast<long long>(sizes[2]), n[0], n[1], n[2], n[3], n[4], n[5], n[6], n[7], n[8]);
  }
  give(out, state);
  give(out, nu);
  give(out, sums);
  give(out, Buffer(1, static_cast<double>(counted[0])));
  fclose(in);
  return fclose(out);
}
