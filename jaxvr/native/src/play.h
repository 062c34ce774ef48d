/* Segments that were traced before, played back: see trace/recorded.py. NEXT is a lane's node, END the
 * one behind its last. */
#ifndef JAXVR_PLAY_H
#define JAXVR_PLAY_H

#include "lanes.h"
#include "watch.h"

/* scalar, length (count): nodes; first, end (rays): the run of each ray. */
typedef struct {
  const real *scalar, *length;
  const int32_t *first, *end;
  int64_t count;
  Watch *watch;
} Nodes;

/* Lanes for rays first to first + count - 1; rows from SUMS on are zero. */
static int fill_runs(const Nodes *nodes, Lanes *lanes, int64_t first, int count, int rows) {
  int n = 0;
  for (int i = 0; i < count; i++) {
    int64_t r = first + i;
    if ((int64_t)nodes->end[r] - nodes->first[r] < 2) continue;
    if (nodes->first[r] < 0 || nodes->end[r] > nodes->count) {
      is_broken(nodes->watch);
      continue;
    }
    for (int k = SUMS; k < rows; k++) lanes->row[k][n] = 0;
    lanes->row[BACK][n] = nodes->scalar[nodes->first[r]];
    lanes->integer[RAY][n] = (int32_t)r;
    lanes->integer[NEXT][n] = nodes->first[r];
    lanes->integer[END][n] = nodes->end[r];
    lanes->integer[SLAB][n] = 0;
    lanes->integer[LOST][n] = 0;
    lanes->integer[FRESH][n] = 1;
    n++;
  }
  return n;
}

/* The segment behind each lane's node. A node of length 0 is a jump to its scalar. */
static void play(const Nodes *nodes, Lanes *lanes, int n) {
  LANES_LOOP
  for (int i = 0; i < n; i++) {
    int node = lanes->integer[NEXT][i] + 1;
    real back = nodes->scalar[node], length = nodes->length[node];
    word_t jump = MASK(length == 0);
    lanes->integer[NEXT][i] = node;
    lanes->integer[FRESH][i] |= (int32_t)jump;
    lanes->row[FRONT][i] = PICK(jump, back, lanes->row[BACK][i]);
    lanes->row[BACK][i] = back;
    lanes->row[LENGTH][i] = length;
  }
}

/* Lanes whose run or ray has ended are handed to `done` and make room; FRESH is cleared. */
static int settle_runs(Lanes *lanes, int n, int rows, real enough,
                       void (*done)(void *, Lanes *, int), void *data) {
  word_t any = 0;
  LANES_LOOP
  for (int i = 0; i < n; i++) {
    lanes->integer[FRESH][i] = 0;
    word_t through = MASK(lanes->integer[NEXT][i] + 1 >= lanes->integer[END][i]);
    any |= through | MASK(lanes->row[SUMS][i] - lanes->row[SUMS + 4][i] >= enough);
  }
  for (int i = n - 1; any && i >= 0; i--) {
    int ended = lanes->row[SUMS][i] - lanes->row[SUMS + 4][i] >= enough;
    if (!ended && lanes->integer[NEXT][i] + 1 < lanes->integer[END][i]) continue;
    done(data, lanes, i);
    move_lane(lanes, rows, --n, i);
  }
  return n;
}

/* Each node belongs to one ray: nothing is shared between threads. NULL: not asked for. */
static void scatter_nodes(const Lanes *lanes, int n, real *scalar, real *length) {
  for (int i = 0; i < n; i++) {
    int node = lanes->integer[NEXT][i], before = node - (lanes->row[LENGTH][i] != 0);
    if (scalar) {
      scalar[before] += lanes->row[SBAR][i];
      scalar[node] += lanes->row[SBAR + 1][i];
    }
    if (length) length[node] += lanes->row[SBAR + 2][i];
  }
}

#endif
