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
  fclose(in);
  return fclose(out);
}
