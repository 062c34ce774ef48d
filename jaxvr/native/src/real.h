/* The working precision, and arithmetic whose rounding errors are known: see numerics/exact.py and
 * numerics/compensated.py, which this follows operation by operation. Compile with contraction of
 * products and sums switched off: where a fused operation is meant, it is written. */
#ifndef JAXVR_REAL_H
#define JAXVR_REAL_H

#include <float.h>
#include <math.h>
#include <stdint.h>
#include <string.h>

#define SMALL_NODES 7

#ifdef JAXVR_DOUBLE
typedef double real;
typedef int64_t word_t;
#define HALF_BITS 27
#define MANTISSA 52
#define REAL_MIN DBL_MIN
#define REAL_EPS DBL_EPSILON
#define EXP_TERMS 13
#define FULL_NODES 23
#define THIN_NODES 9
#define EXP_LOWEST -708.0
#define LN2_HIGH 0x1.62e42fee00000p-1
#define LN2_LOW 0x1.a39ef35793c76p-33
#define ROUNDER 0x1.8p52
#define LARGEST 1e90
#define FMA(a, b, c) __builtin_fma(a, b, c)
#define ABS(x) __builtin_fabs(x)
#define SQRT(x) __builtin_sqrt(x)
#else
typedef float real;
typedef int32_t word_t;
#define HALF_BITS 12
#define MANTISSA 23
#define REAL_MIN FLT_MIN
#define REAL_EPS FLT_EPSILON
#define EXP_TERMS 7
#define FULL_NODES 13
#define THIN_NODES 5
#define EXP_LOWEST -87.0f
#define LN2_HIGH 0x1.62e400p-1f
#define LN2_LOW 0x1.7f7d1cp-20f
#define ROUNDER 0x1.8p23f
#define LARGEST 1e10f
#define FMA(a, b, c) __builtin_fmaf(a, b, c)
#define ABS(x) __builtin_fabsf(x)
#define SQRT(x) __builtin_sqrtf(x)
#endif

#define INLINE static inline __attribute__((always_inline))

/* Iterations of the next loop do not depend on each other. */
#if defined(__clang__)
#define LANES_LOOP _Pragma("clang loop vectorize(assume_safety) interleave(disable)")
#else
#define LANES_LOOP _Pragma("GCC ivdep")
#endif

/* Conditions as integers as wide as a number, all bits or none: compilers turn sums of such masks
 * into vector instructions, where they give up on a tangle of single bits. */
#define MASK(condition) ((condition) ? (word_t)-1 : (word_t)0)
#define PICK(mask, yes, no) ((mask) != 0 ? (yes) : (no))

INLINE real least(real a, real b) { return a < b ? a : b; }
INLINE real most(real a, real b) { return a > b ? a : b; }

/* s + e = a + b exactly (Knuth). */
INLINE void two_sum(real a, real b, real *s, real *e) {
  real sum = a + b, t = sum - a;
  *s = sum;
  *e = (a - (sum - t)) + (b - t);
}

/* The high half of x: at most half of the significant bits, rounded as an integer. */
INLINE real head(real x) {
  word_t bits;
  memcpy(&bits, &x, sizeof x);
  bits = (bits + ((word_t)1 << (HALF_BITS - 1))) & -((word_t)1 << HALF_BITS);
  memcpy(&x, &bits, sizeof x);
  return x;
}

/* What rounding a * b to p has lost, exactly (barring underflow). */
INLINE real product_low(real a, real b, real p) {
#if defined(__FMA__) || defined(__ARM_FEATURE_FMA)
  return FMA(a, b, -p);
#else
  real ah = head(a), al = a - ah, bh = head(b), bl = b - bh;
  return ((ah * bh - p) + ah * bl + al * bh) + al * bl;
#endif
}

/* a b + c, fused where the machine has it; used where either rounding will do. */
INLINE real muladd(real a, real b, real c) {
#if defined(__FMA__) || defined(__ARM_FEATURE_FMA)
  return FMA(a, b, c);
#else
  return a * b + c;
#endif
}

/* exp(x) for x <= 0, to about one unit in the last place; 0 far below. x = n ln 2 + r, and the
 * Taylor series of exp(r), |r| <= ln(2) / 2, is below rounding after EXP_TERMS terms. */
INLINE real exp_negative(real x) {
  static const real inverse[] = {1.0, 1.0, 1.0 / 2, 1.0 / 6, 1.0 / 24, 1.0 / 120, 1.0 / 720,
                                 1.0 / 5040, 1.0 / 40320, 1.0 / 362880, 1.0 / 3628800,
                                 1.0 / 39916800, 1.0 / 479001600, 1.0 / 6227020800.0};
  real y = x > (real)EXP_LOWEST ? x : (real)EXP_LOWEST;
  real shifted = y * (real)1.4426950408889634 + (real)ROUNDER;
  word_t n;
  memcpy(&n, &shifted, sizeof n);
  real whole = shifted - (real)ROUNDER;
  real r = muladd(-whole, (real)LN2_LOW, muladd(-whole, (real)LN2_HIGH, y));
  real sum = inverse[EXP_TERMS];
#pragma GCC unroll 16
  for (int k = EXP_TERMS - 1; k >= 0; k--) sum = muladd(sum, r, inverse[k]);
  /* The low bits of `shifted` are n in two's complement: added to the exponent of the sum. */
  word_t bits;
  memcpy(&bits, &sum, sizeof bits);
  bits = (word_t)((uint64_t)bits + ((uint64_t)n << MANTISSA));
  memcpy(&sum, &bits, sizeof bits);
  return x > (real)EXP_LOWEST ? sum : 0;
}

/* A pair (total, excess) stands for total - excess. */
INLINE void add_to(real *total, real *excess, real x) {
  real y = x - *excess, next = *total + y;
  *excess = (next - *total) - y;
  *total = next;
}

INLINE real exp_minus(real total, real excess) { return exp_negative(-total) * (1 + excess); }

#endif
