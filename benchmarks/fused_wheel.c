/* JᵀJ, Jᵀr and rᵀr of the wheel in one pass, written by hand for this model: the yardstick.
 *
 * Samples lie in SIMD lanes. Of each axis the twelve columns that are not zero (offset, gain, three
 * angles, tilt, phase, four of speed, residual) are computed for 80 samples at a time and multiplied
 * in 4×4 tiles whose sums stay in registers. See evaluate.py for how it is compiled.
 */
#include <math.h>

#define B 80
#define COLUMNS 12
typedef double lanes __attribute__((vector_size(64), aligned(8), may_alias));

__attribute__((simd("notinbranch"), const)) double sin(double);
__attribute__((simd("notinbranch"), const)) double cos(double);

static const double RADIUS = 0.28, GRAVITY = 9.80665;

/* R = Rx·Ry·Rz and its slopes in the three angles, row by row. */
static void rotations(const double *angle, double R[4][3][3]) {
  double c[3], s[3];
  for (int k = 0; k < 3; ++k) c[k] = cos(angle[k]), s[k] = sin(angle[k]);
  for (int k = 0; k < 4; ++k) {
    double m[3][3][3];
    for (int axis = 0; axis < 3; ++axis) {
      const int i = (axis + 1) % 3, j = (axis + 2) % 3, slope = k == axis + 1;
      const double u = slope ? -s[axis] : c[axis], w = slope ? c[axis] : s[axis];
      for (int a = 0; a < 9; ++a) m[axis][a / 3][a % 3] = 0;
      m[axis][axis][axis] = !slope;
      m[axis][i][i] = m[axis][j][j] = u;
      m[axis][j][i] = w;
      m[axis][i][j] = -w;
    }
    for (int i = 0; i < 3; ++i)
      for (int j = 0; j < 3; ++j) {
        R[k][i][j] = 0;
        for (int a = 0; a < 3; ++a)
          for (int b = 0; b < 3; ++b) R[k][i][j] += m[0][i][a] * m[1][a][b] * m[2][b][j];
      }
  }
}

/* What the axes have in common: force on the bench and its slopes in tilt, phase and speed. */
struct bench {
  double along[B], across[B], tilted_along[B], tilted_across[B];
  double by_along[5][B], by_across[5][B];
};

static void common(const double *x, const double *time, struct bench *restrict b) {
  const double pull = GRAVITY * sin(x[9]), level = GRAVITY * cos(x[9]);
  for (int l = 0; l < B; ++l) {
    const double t = time[l], t2 = t * t, t3 = t2 * t;
    const double rate = x[11] + t * (x[12] + t * (x[13] + t * x[14]));
    const double bend = x[12] + t * (2 * x[13] + t * 3 * x[14]);
    const double angle =
        x[10] + t * (x[11] + t * (x[12] / 2 + t * (x[13] / 3 + t * (x[14] / 4))));
    const double c = cos(angle), s = sin(angle), pc = pull * c, ps = pull * s;
    const double twice = 2 * RADIUS * rate;
    b->along[l] = RADIUS * rate * rate + pc;
    b->across[l] = RADIUS * bend + ps;
    b->tilted_along[l] = level * c;
    b->tilted_across[l] = level * s;
    b->by_along[0][l] = -ps;
    b->by_across[0][l] = pc;
    b->by_along[1][l] = twice - ps * t;
    b->by_across[1][l] = pc * t;
    b->by_along[2][l] = twice * t - ps * (t2 / 2);
    b->by_across[2][l] = RADIUS + pc * (t2 / 2);
    b->by_along[3][l] = twice * t2 - ps * (t3 / 3);
    b->by_across[3][l] = 2 * RADIUS * t + pc * (t3 / 3);
    b->by_along[4][l] = twice * t3 - ps * (t2 * t2 / 4);
    b->by_across[4][l] = 3 * RADIUS * t2 + pc * (t2 * t2 / 4);
  }
}

static void columns(const double *x, int i, double R[4][3][3], const struct bench *restrict b,
                    const double *v, double (*restrict a)[B]) {
  const double gain = x[3 + i], up = GRAVITY * cos(x[9]), down = GRAVITY * sin(x[9]);
  const double g0 = gain * R[0][i][0], g1 = gain * R[0][i][1], g2 = gain * R[0][i][2];
  for (int l = 0; l < B; ++l) {
    const double p = b->along[l], q = b->across[l];
    const double force = R[0][i][0] * p + R[0][i][1] * q + R[0][i][2] * up;
    a[0][l] = 1;
    a[1][l] = force;
    for (int k = 0; k < 3; ++k)
      a[2 + k][l] = gain * (R[1 + k][i][0] * p + R[1 + k][i][1] * q + R[1 + k][i][2] * up);
    a[5][l] = g0 * b->tilted_along[l] + g1 * b->tilted_across[l] - g2 * down;
    for (int k = 0; k < 5; ++k) a[6 + k][l] = g0 * b->by_along[k][l] + g1 * b->by_across[k][l];
    a[11][l] = x[i] + gain * force - v[l];
  }
}

static __attribute__((noinline)) void tile(const double (*x)[B], const double (*y)[B], lanes *sum) {
  lanes s[16];
#pragma GCC unroll 16
  for (int k = 0; k < 16; ++k) s[k] = sum[k];
  for (int l = 0; l < B; l += 8)
#pragma GCC unroll 4
    for (int i = 0; i < 4; ++i)
#pragma GCC unroll 4
      for (int j = 0; j < 4; ++j)
        s[4 * i + j] += *(const lanes *)(x[i] + l) * *(const lanes *)(y[j] + l);
#pragma GCC unroll 16
  for (int k = 0; k < 16; ++k) sum[k] = s[k];
}

/* result[axis][a][b], b ≥ a: sums of products of columns; v holds the axes one after the other. */
void fused_wheel(const double *x, const double *t, const double *v, long n, double *result) {
  double R[4][3][3];
  rotations(x + 6, R);
  lanes sum[3][6][16] = {0};
  struct bench b;
  double a[COLUMNS][B] __attribute__((aligned(64)));
  for (long first = 0; first < n; first += B) {
    const int length = n - first < B ? (int)(n - first) : B;
    double time[B], reading[B];
    for (int l = 0; l < B; ++l) time[l] = t[first + (l < length ? l : 0)];
    common(x, time, &b);
    for (int i = 0; i < 3; ++i) {
      for (int l = 0; l < B; ++l) reading[l] = v[i * n + first + (l < length ? l : 0)];
      columns(x, i, R, &b, reading, a);
      for (int k = 0; length < B && k < COLUMNS; ++k)
        for (int l = length; l < B; ++l) a[k][l] = 0;
      for (int p = 0, k = 0; p < 3; ++p)
        for (int q = p; q < 3; ++q, ++k)
          tile((const double (*)[B])(a + 4 * p), (const double (*)[B])(a + 4 * q), sum[i][k]);
    }
  }
  for (int i = 0; i < 3; ++i)
    for (int p = 0, k = 0; p < 3; ++p)
      for (int q = p; q < 3; ++q, ++k)
        for (int m = 0; m < 16; ++m) {
          double total = 0;
          for (int l = 0; l < 8; ++l) total += sum[i][k][m][l];
          result[(i * COLUMNS + 4 * p + m / 4) * COLUMNS + 4 * q + m % 4] = total;
        }
}
