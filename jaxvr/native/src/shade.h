/* The pieces of the lanes' segments, composited: see optics/partition.py, composite/over.py. */
#ifndef JAXVR_SHADE_H
#define JAXVR_SHADE_H

#include "lanes.h"
#include "slab.h"

/* The current pieces of m lanes, and which lanes those are. */
typedef struct {
  _Alignas(64) int32_t lane[LANES], slab[LANES], onward[LANES];
  _Alignas(64) real t[2][LANES], place[2][LANES], fraction[LANES], width[LANES], length[LANES];
  _Alignas(64) real front[4][LANES], change[4][LANES], w[LANES], w_back[LANES], b1[LANES],
      b2[LANES];
} Pieces;

/* Cursors to the fronts of the segments, in a slab that has them; which lanes have something to
 * shade. all: also those that are transparent or without length, for derivatives. */
static int begin_segments(const Transfer *tf, Lanes *lanes, int n, int all, int32_t *lane) {
  int32_t wrong[LANES], seen[LANES];
  const Slab *restrict slabs = tf->slabs;
  LANES_LOOP
  for (int i = 0; i < n; i++) {
    real front = lanes->row[FRONT][i], back = lanes->row[BACK][i];
    const Slab *slab = slabs + lanes->integer[SLAB][i];
    int transparent = (least(front, back) >= slab->dark_from) & (most(front, back) <= slab->dark_to);
    lanes->row[CURSOR][i] = front;
    seen[i] = (!transparent & (lanes->row[LENGTH][i] > 0)) | all;
    wrong[i] = lanes->integer[FRESH][i] | (front < slab->floor) | (front > slab->ceiling);
  }
  int m = 0;
  for (int i = 0; i < n; i++) {
    if (wrong[i]) {
      real front = lanes->row[FRONT][i], back = lanes->row[BACK][i];
      int k = lanes->integer[SLAB][i] = locate(tf, front);
      int transparent =
          least(front, back) >= slabs[k].dark_from && most(front, back) <= slabs[k].dark_to;
      seen[i] = (!transparent && lanes->row[LENGTH][i] > 0) || all;
    }
    if (seen[i]) lane[m++] = i;
  }
  return m;
}

/* Cuts the next piece off each segment: `Piece` of optics/partition.py, then `ends`. */
INLINE void cut_lanes(const Transfer *tf, Lanes *lanes, Pieces *p, int m, const int dense,
                      const int derivatives) {
  const Slab *restrict slabs = tf->slabs;
  LANES_LOOP
  for (int j = 0; j < m; j++) {
    int i = dense ? j : p->lane[j], k = lanes->integer[SLAB][i];
    const Slab *slab = slabs + k;
    real front = lanes->row[FRONT][i], back = lanes->row[BACK][i], scalar = lanes->row[CURSOR][i];
    real floor = slab->floor, ceiling = slab->ceiling, low = slab->low;
    real difference = back - front;
    int up = difference > 0, flat = difference == 0, jump = slab->jump != 0;
    int above = (scalar > ceiling) | (flat & (scalar == ceiling)), below = scalar < floor;
    int astray = above | below;
    real end = up ? least(back, ceiling) : most(back, floor);
    int beyond = up ? back > ceiling : back < floor;
    int onward = (beyond & !flat) | astray, upward = astray ? above : up;
    real per_scalar = 1 / (flat ? 1 : difference);
    real fraction = flat ? 1 : (end - scalar) * per_scalar;
    fraction = jump ? JUMP_WIDTH * ABS(per_scalar) : fraction;
    fraction = astray ? 0 : fraction;
    real slope = astray ? 0 : slab->slope;
    real place0 = jump ? (real)!up : (scalar - low) * slope;
    real place1 = jump ? (real)up : (end - low) * slope;
    real length = lanes->row[LENGTH][i] * fraction;
    p->slab[j] = k;
    p->onward[j] = onward;
    p->length[j] = length;
    lanes->row[CURSOR][i] = astray ? scalar : end;
    lanes->integer[SLAB][i] = k + (onward ? (upward ? 1 : -1) : 0);
    for (int c = 0; c < 4; c++) {
      real left = slab->left[c], change = slab->change[c];
      real at0 = left + place0 * change, at1 = left + place1 * change;
      p->front[c][j] = at0;
      p->change[c][j] = at1 - at0;
    }
    if (derivatives) {
      p->t[0][j] = (scalar - front) * per_scalar;
      p->t[1][j] = flat ? 1 : (end - front) * per_scalar;
      p->place[0][j] = place0;
      p->place[1][j] = place1;
      p->fraction[j] = fraction;
      p->width[j] = slab->width;
    }
  }
}

/* dense: piece j is lane j, and nothing has to be gathered. */
INLINE void cut(const Transfer *tf, Lanes *lanes, Pieces *p, int m, int dense,
                const int derivatives) {
  if (dense) cut_lanes(tf, lanes, p, m, 1, derivatives);
  else cut_lanes(tf, lanes, p, m, 0, derivatives);
}

INLINE void integrate_nodes(const Rule *rule, const int nodes, Pieces *p, int m,
                            const int derivatives) {
  int small = rule->small;
  LANES_LOOP
  for (int j = 0; j < m; j++) {
    real length = p->length[j];
    real a = p->front[0][j] * length, b = (p->front[0][j] + p->change[0][j]) * length, b0, b1, b2;
    a = least(most(a, 0), (real)LARGEST), b = least(most(b, 0), (real)LARGEST);
    moments(rule, nodes, a, b, &b0, &b1, &b2);
    real half = (real)0.5 * b1, back = a * half + b * b2;
    real all = least(a * b0 + b * half + back, 1);
    if (nodes < 13) {
      real alpha = opacity((real)0.5 * (a + b));
      all = small ? alpha : all;
      back = small ? least(back, alpha) : back;
    }
    p->w[j] = all;
    p->w_back[j] = back;
    if (derivatives) p->b1[j] = b1, p->b2[j] = b2;
  }
}

/* Weights of the end colours of m pieces, by one of the rules of numerics/rules.py. */
INLINE void integrate(const Rule *rule, Pieces *p, int m, const int derivatives) {
  switch (rule->count) {
    case 5: integrate_nodes(rule, 5, p, m, derivatives); break;
    case 7: integrate_nodes(rule, 7, p, m, derivatives); break;
#ifdef JAXVR_DOUBLE
    case 23: integrate_nodes(rule, 23, p, m, derivatives); break;
#else
    case 13: integrate_nodes(rule, 13, p, m, derivatives); break;
#endif
    default: integrate_nodes(rule, rule->count, p, m, derivatives);
  }
}

/* The pieces go over the lanes' sums. */
INLINE void composite_lanes(Lanes *lanes, const Pieces *p, int m, const int dense) {
  LANES_LOOP
  for (int j = 0; j < m; j++) {
    int i = dense ? j : p->lane[j];
    real through = exp_minus(lanes->row[SUMS][i], lanes->row[SUMS + 4][i]);
    real extinction = p->front[0][j];
    real a = extinction * p->length[j], b = (extinction + p->change[0][j]) * p->length[j];
    real depth = (real)0.5 * (a + b), sum = lanes->row[SUMS][i], excess = lanes->row[SUMS + 4][i];
    add_to(&sum, &excess, depth);
    lanes->row[SUMS][i] = sum;
    lanes->row[SUMS + 4][i] = excess;
    for (int c = 1; c < 4; c++) {
      real light = p->front[c][j] * p->w[j] + p->change[c][j] * p->w_back[j];
      sum = lanes->row[SUMS + c][i], excess = lanes->row[SUMS + 4 + c][i];
      add_to(&sum, &excess, through * light);
      lanes->row[SUMS + c][i] = sum;
      lanes->row[SUMS + 4 + c][i] = excess;
    }
  }
}

INLINE void composite(Lanes *lanes, const Pieces *p, int m, int dense) {
  if (dense) composite_lanes(lanes, p, m, 1);
  else composite_lanes(lanes, p, m, 0);
}

/* The lanes whose segment goes on: they stay in `lane`. */
static inline int go_on(Pieces *p, int m) {
  int left = 0;
  for (int j = 0; j < m; j++)
    if (p->onward[j]) p->lane[left++] = p->lane[j];
  return left;
}

static void shade(const Transfer *tf, const Rule *rule, Lanes *lanes, int n) {
  Pieces p;
  int m = begin_segments(tf, lanes, n, 0, p.lane);
  while (m > 0) {
    int dense = m == n;
    cut(tf, lanes, &p, m, dense, 0);
    integrate(rule, &p, m, 0);
    composite(lanes, &p, m, dense);
    m = go_on(&p, m);
  }
}

#endif
