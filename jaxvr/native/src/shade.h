/* The pieces of the lanes' segments, composited: see optics/partition.py, composite/over.py. */
#ifndef JAXVR_SHADE_H
#define JAXVR_SHADE_H

#include "lanes.h"
#include "slab.h"

/* The current pieces of m lanes, which lanes those are, and the way to the next slab, 0 for none. */
typedef struct {
  _Alignas(64) int32_t lane[LANES], onward[LANES];
  _Alignas(64) real t[2][LANES], place[2][LANES], fraction[LANES], length[LANES];
  _Alignas(64) real slope[2][LANES], rate[2][LANES];
  _Alignas(64) real front[4][LANES], change[4][LANES], w[LANES], w_back[LANES];
  _Alignas(64) real a[LANES], b[LANES], b0[LANES], b1[LANES], b2[LANES];
} Pieces;

/* Adds what a lane has gathered of its slab's gradient to `table` (2 K, NODE_PAIR), whose row
 * left + right has the cotangents of a slab's two control points. */
static inline void hand_in(const Transfer *tf, Lanes *lanes, int lane, double *table) {
  int k = lanes->integer[SLAB][lane], left = k > 0 ? k - 1 : 0;
  double *row = table + NODE_PAIR * (left + (k < tf->count ? k : tf->count - 1));
  for (int c = 0; c < NODE_PAIR; c++) {
    row[c] += lanes->row[TBAR + c][lane];
    lanes->row[TBAR + c][lane] = 0;
  }
}

/* A lane goes to slab k. Its numbers stay in the lane until it leaves: most pieces are in the slab
 * of the one before, and vectors of records from all over a table are slow to gather. The same
 * holds for the gradient; `table` is NULL where none is wanted. */
static inline void go_to_slab(const Transfer *tf, Lanes *lanes, int lane, int k, double *table) {
  const real *slab = tf->slabs + (int64_t)k * SLAB_NUMBERS;
  if (table) hand_in(tf, lanes, lane, table);
  lanes->integer[SLAB][lane] = k;
  for (int c = 0; c < SLAB_NUMBERS; c++) lanes->row[RECORD + c][lane] = slab[c];
}

/* Cursors to the fronts of the segments, in a slab that has them; the number of lanes with something
 * to shade, which `lane` names unless it is all of them. all: also those that are transparent or
 * without length, for derivatives. */
static int begin_segments(const Transfer *tf, Lanes *lanes, int n, int all, int32_t *lane,
                          double *table) {
  _Alignas(64) int32_t wrong[LANES], seen[LANES];
  real(*row)[LANES] = lanes->row;
  int any_wrong = 0, all_seen = -1;
  LANES_LOOP
  for (int i = 0; i < n; i++) {
    real front = row[FRONT][i];
    word_t outside = MASK(front < row[RECORD + FLOOR][i]) | MASK(front > row[RECORD + CEILING][i]);
    row[CURSOR][i] = front;
    wrong[i] = (int32_t)outside | lanes->integer[FRESH][i];
    any_wrong |= wrong[i];
  }
  for (int i = 0; any_wrong && i < n; i++)
    if (wrong[i]) go_to_slab(tf, lanes, i, locate(tf, row[FRONT][i]), table);
  LANES_LOOP
  for (int i = 0; i < n; i++) {
    real front = row[FRONT][i], back = row[BACK][i];
    word_t dark = MASK(least(front, back) >= row[RECORD + DARK_FROM][i]);
    dark &= MASK(most(front, back) <= row[RECORD + DARK_TO][i]);
    seen[i] = (int32_t)(~dark & MASK(row[LENGTH][i] > 0)) | -all;
    all_seen &= seen[i];
  }
  if (all_seen) return n;
  int m = 0;
  for (int i = 0; i < n; i++)
    if (seen[i]) lane[m++] = i;
  return m;
}

/* Cuts the next piece off each segment: `Piece` of optics/partition.py, then `ends`. */
INLINE void cut_lanes(Lanes *lanes, Pieces *p, int m, const int dense, const int derivatives) {
  real(*row)[LANES] = lanes->row;
  LANES_LOOP
  for (int j = 0; j < m; j++) {
    int i = dense ? j : p->lane[j];
    real front = row[FRONT][i], back = row[BACK][i], scalar = row[CURSOR][i];
    real floor = row[RECORD + FLOOR][i], ceiling = row[RECORD + CEILING][i];
    real low = row[RECORD + LOW][i];
    real difference = back - front;
    int up = difference > 0, flat = difference == 0, jump = floor == ceiling;
    int hard_floor = row[RECORD + HARD_FLOOR][i] != 0;
    int hard_ceiling = row[RECORD + HARD_CEILING][i] != 0;
    int above = (scalar > ceiling) | (flat & (scalar == ceiling)), below = scalar < floor;
    int astray = above | below;
    real end = up ? least(back, ceiling) : most(back, floor);
    int rises = (back > ceiling) | (hard_ceiling & (back == ceiling));
    int beyond = up ? rises : back < floor;
    int onward = (beyond & !flat) | astray, upward = astray ? above : up;
    real per_scalar = 1 / (flat ? 1 : difference);
    real fraction = flat ? 1 : (end - scalar) * per_scalar;
    fraction = astray | jump ? 0 : fraction;
    real slope = astray ? 0 : row[RECORD + SLOPE][i];
    real place0 = jump ? (real)!up : (scalar - low) * slope;
    real place1 = jump ? (real)up : (end - low) * slope;
    real length = row[LENGTH][i] * fraction;
    p->onward[j] = onward ? (upward ? 1 : -1) : 0;
    row[CURSOR][i] = astray ? scalar : end;
    for (int c = 0; c < 4; c++) {
      real left = row[RECORD + LEFT + c][i], change = row[RECORD + CHANGE + c][i];
      real at0 = left + place0 * change, at1 = left + place1 * change;
      p->front[c][j] = at0;
      p->change[c][j] = at1 - at0;
    }
    real a = p->front[0][j] * length, b = (p->front[0][j] + p->change[0][j]) * length;
    p->a[j] = least(most(a, 0), (real)LARGEST);
    p->b[j] = least(most(b, 0), (real)LARGEST);
    if (derivatives) {
      p->t[0][j] = (scalar - front) * per_scalar;
      p->t[1][j] = flat ? 1 : (end - front) * per_scalar;
      p->place[0][j] = place0;
      p->place[1][j] = place1;
      p->length[j] = length;
      p->fraction[j] = fraction;
      int from_below = hard_floor & (scalar == floor) & (scalar != front);
      int hard_start = (up ? from_below : hard_ceiling & (scalar == ceiling)) & !flat & !astray;
      int hard_end = (up ? hard_ceiling : hard_floor) & onward & !astray;
      p->slope[0][j] = hard_start ? 0 : slope;
      p->slope[1][j] = hard_end ? 0 : slope;
      p->rate[0][j] = hard_start ? -per_scalar : 0;
      p->rate[1][j] = hard_end ? per_scalar : 0;
    }
  }
}

/* dense: piece j is lane j, and nothing has to be gathered. */
INLINE void cut(Lanes *lanes, Pieces *p, int m, int dense, const int derivatives) {
  if (dense) cut_lanes(lanes, p, m, 1, derivatives);
  else cut_lanes(lanes, p, m, 0, derivatives);
}

/* Moments of the pieces first to end - 1; `nodes` is a constant. */
INLINE void sum_moments(const Rule *rule, const int nodes, Pieces *p, int first, int end) {
  LANES_LOOP
  for (int j = first; j < end; j++)
    moments(rule, nodes, p->a[j], p->b[j], &p->b0[j], &p->b1[j], &p->b2[j]);
}

INLINE void thin_moments(const Rule *rule, Pieces *p, int first, int end) {
  LANES_LOOP
  for (int j = first; j < end; j++)
    sum_nodes(&rule->thin, THIN_NODES, p->a[j], p->b[j], &p->b0[j], &p->b1[j], &p->b2[j]);
}

/* Weights of the end colours of m pieces. A group of pieces that are all thin takes fewer nodes. */
#define GROUP 16
static void integrate(const Rule *rule, Pieces *p, int m) {
  int end = (m + GROUP - 1) / GROUP * GROUP;
  for (int j = m; j < end; j++) p->a[j] = p->b[j] = 0;
  for (int first = 0; first < end; first += GROUP) {
    real largest = 0;
    for (int j = first; j < first + GROUP; j++) largest = most(largest, most(p->a[j], p->b[j]));
    if (rule->small) sum_moments(rule, SMALL_NODES, p, first, first + GROUP);
    else if (largest <= rule->limit) thin_moments(rule, p, first, first + GROUP);
    else sum_moments(rule, FULL_NODES, p, first, first + GROUP);
  }
  int small = rule->small;
  LANES_LOOP
  for (int j = 0; j < end; j++) {
    real a = p->a[j], b = p->b[j], half = (real)0.5 * p->b1[j], back = a * half + b * p->b2[j];
    p->w[j] = least(a * p->b0[j] + b * half + back, 1);
    p->w_back[j] = back;
  }
  if (!small) return;
  LANES_LOOP
  for (int j = 0; j < end; j++) {
    real alpha = opacity((real)0.5 * (p->a[j] + p->b[j]));
    p->w[j] = alpha;
    p->w_back[j] = least(p->w_back[j], alpha);
  }
}

/* The pieces go over the lanes' sums. */
INLINE void composite_lanes(Lanes *lanes, const Pieces *p, int m, const int dense) {
  LANES_LOOP
  for (int j = 0; j < m; j++) {
    int i = dense ? j : p->lane[j];
    real through = exp_minus(lanes->row[SUMS][i], lanes->row[SUMS + 4][i]);
    real depth = (real)0.5 * (p->a[j] + p->b[j]), sum = lanes->row[SUMS][i], excess = lanes->row[SUMS + 4][i];
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

/* The lanes whose segment goes on, into the next slab: they stay in `lane`. */
static int go_on(const Transfer *tf, Lanes *lanes, Pieces *p, int m, int dense, double *table) {
  int any = 0, left = 0;
  LANES_LOOP
  for (int j = 0; j < m; j++) any |= p->onward[j];
  for (int j = 0; any && j < m; j++) {
    if (!p->onward[j]) continue;
    int i = dense ? j : p->lane[j];
    int to = lanes->integer[SLAB][i] + p->onward[j];
    go_to_slab(tf, lanes, i, to < 0 ? 0 : to > tf->count ? tf->count : to, table);
    p->lane[left++] = i;
  }
  return left;
}

static void shade(const Transfer *tf, const Rule *rule, Lanes *lanes, int n) {
  Pieces p;
  int m = begin_segments(tf, lanes, n, 0, p.lane, NULL);
  while (m > 0) {
    int dense = m == n;
    cut(lanes, &p, m, dense, 0);
    integrate(rule, &p, m);
    composite(lanes, &p, m, dense);
    m = go_on(tf, lanes, &p, m, dense, NULL);
  }
}

#endif
