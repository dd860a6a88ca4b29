// Half-size pairs: s and y as bfloat16, two of them in the bits of one float. See _packed.py for the
// layout. `two_loop.cuh` goes in front; only float32.
#pragma once

POINT unsigned bits_of(float x) { return __float_as_uint(x); }
POINT float from_bits(unsigned bits) { return __uint_as_float(bits); }

// To the nearest bfloat16, ties to even; a NaN may become another one or, at worst, infinite.
POINT float rounded(float x) {
  const unsigned bits = bits_of(x);
  return from_bits((bits + 0x7fffu + (bits >> 16 & 1u)) & 0xffff0000u);
}
POINT Vec3<float> rounded(Vec3<float> v) { return {rounded(v.x), rounded(v.y), rounded(v.z)}; }

// y in the upper half, s in the lower: |y| = 1, so that the float is finite.
POINT float packed(float s, float y) { return from_bits(bits_of(s) >> 16 | (bits_of(y) & 0xffff0000u)); }

// The history of one point, [lanes]: header, then three lanes per pair, newest first.
template <int K> struct PackedHistory {
  static constexpr bool kept = K <= 8;  // more pairs than that are read again in both loops
  static constexpr int groups = (3 * K + 3) / 4;  // of 16 bytes
  static constexpr int lanes = 8 + 4 * groups;

  float* row;
  float pairs[kept ? 4 * groups : 1];
  Vec3<float> position, gradient;  // of the last visible step
  float counter;                   // 0: never visible; c: holds c - 1 pairs

  POINT explicit PackedHistory(float* at) : row(at) {
    const Lanes<float> first = load(row), second = load(row + 4);
    position = first.v;
    counter = first.spare;
    gradient = second.v;
    if constexpr (kept) {
#pragma unroll
      for (int i = 0; i < groups; ++i) {
        const Lanes<float> four = load(row + 8 + 4 * i);
        pairs[4 * i] = four.v.x;
        pairs[4 * i + 1] = four.v.y;
        pairs[4 * i + 2] = four.v.z;
        pairs[4 * i + 3] = four.spare;
      }
    }
  }

  POINT float lane(int i) const {
    if constexpr (kept) return pairs[i];
    return row[8 + i];
  }
  static POINT float s_of(float lane) { return from_bits(bits_of(lane) << 16); }
  static POINT float y_of(float lane) { return from_bits(bits_of(lane) & 0xffff0000u); }
  POINT Vec3<float> pair_s(int j) const {
    return {s_of(lane(3 * j)), s_of(lane(3 * j + 1)), s_of(lane(3 * j + 2))};
  }
  POINT Vec3<float> pair_y(int j) const {
    return {y_of(lane(3 * j)), y_of(lane(3 * j + 1)), y_of(lane(3 * j + 2))};
  }

  // The cosine is 0 where rounding has left no s.y > 0 of it.
  static POINT Pair<float> as_stored(Pair<float> pair) {
    const Vec3<float> s = rounded(pair.s), y = rounded(pair.y);
    const float sy = dot(s, y);
    return {s, y, sy > 0.0f && isfinite(sy) ? pair.cosine : 0.0f};
  }

  // Put the pair in front, if it is accepted, and write pairs and header back.
  POINT void write(Pair<float> pair, bool accepted) {
    store(row, Lanes<float>{position, counter});
    store(row + 4, Lanes<float>{gradient, 0.0f});
    if (!accepted) return;
    const float newest[3] = {packed(pair.s.x, pair.y.x), packed(pair.s.y, pair.y.y), packed(pair.s.z, pair.y.z)};
    if constexpr (kept) {
#pragma unroll
      for (int i = groups - 1; i >= 0; --i) move(i, newest);
    } else {
#pragma unroll 1
      for (int i = groups - 1; i >= 0; --i) move(i, newest);
    }
  }

  // Four lanes move by a pair, the last ones first.
  POINT void move(int i, const float (&newest)[3]) {
    float four[4];
#pragma unroll
    for (int k = 3; k >= 0; --k) {
      const int to = 4 * i + k;
      four[k] = to < 3 ? (to == 0 ? newest[0] : to == 1 ? newest[1] : newest[2])
                       : to < 3 * K ? lane(to < 3 ? 0 : to - 3) : 0.0f;
      if constexpr (kept) pairs[to] = four[k];
    }
    store(row + 8 + 4 * i, Lanes<float>{{four[0], four[1], four[2]}, four[3]});
  }
};
