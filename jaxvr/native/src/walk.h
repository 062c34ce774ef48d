/* From cell to cell: see trace/raycast.py. A block is filled with rays that enter the mesh;
 * `arrive` finds the segment of each lane's new cell, `leave` names the cell behind it, and
 * `settle` lets rays that left the mesh enter again or go. */
#ifndef JAXVR_WALK_H
#define JAXVR_WALK_H

#include "entry.h"

/* As in _core/status.py. */
#define STATUS_LOST 1
#define STATUS_BROKEN 8

/* axes (3, N); numbers (9, N): origin, S_x, S_y, their lost parts, sign, stretch. bounds (3, N), or
 * NULL for rays that are seen from the eye on: near, far, and stop, the depth behind which nothing
 * can be seen any more. */
typedef struct {
  int64_t count;
  const int32_t *axes;
  const real *numbers, *bounds;
} Rays;

typedef struct {
  Mesh mesh;
  Tree tree;
  Rays rays;
} World;

typedef struct {
  int n;
  int64_t steps; /* that its rays have made, together */
  Ray rays[LANES];
  Entries entries[LANES];
  Lanes lanes;
} Block;

static inline void load_ray(const Rays *rays, int64_t r, Ray *ray) {
  int64_t n = rays->count;
  const real *x = rays->numbers + r;
  for (int k = 0; k < 3; k++) {
    ray->axis[k] = rays->axes[k * n + r];
    ray->origin[k] = x[k * n];
  }
  ray->x_high = head(x[3 * n]), ray->x_rest = x[3 * n] - ray->x_high, ray->x_low = head(x[5 * n]);
  ray->y_high = head(x[4 * n]), ray->y_rest = x[4 * n] - ray->y_high, ray->y_low = head(x[6 * n]);
  ray->sign = x[7 * n];
}

/* A lane's ray goes through its next entry, if it has one. */
static int enter(const World *world, Block *block, int lane) {
  Lanes *lanes = &block->lanes;
  int slot = lanes->integer[SLOT][lane];
  Entries *list = block->entries + slot;
  const Ray *ray = block->rays + slot;
  if (list->next == list->count) {
    if (!list->more) return 0;
    real depth = list->depth[list->count - 1];
    int32_t face = list->face[list->count - 1];
    search(&world->mesh, &world->tree, 1, ray, list, &depth, &face);
    if (!list->count) return 0;
  }
  if (list->depth[list->next] > lanes->row[STOP][lane]) return 0;
  int32_t word = list->face[list->next++];
  FaceSeen face;
  see_face(&world->mesh, ray, word >> 4, word & 3, &face);
  for (int v = 0; v < 3; v++) {
    for (int k = 0; k < VERTEX; k++) lanes->row[FACE + v * VERTEX + k][lane] = face.vertex[v][k];
    lanes->row[WEIGHT + v][lane] = face.weight[v];
  }
  lanes->row[DEPTH][lane] = face.z;
  lanes->row[DEPTH + 1][lane] = face.z_low;
  lanes->row[LEAD][lane] = 0;
  lanes->row[VALUE][lane] = lanes->row[BACK][lane] = face.value;
  lanes->integer[NEXT][lane] = word & ~8;
  lanes->integer[POSITIVE][lane] = face.positive;
  lanes->integer[FRESH][lane] = 1;
  return 1;
}

/* Lanes for the rays first to first + count - 1 that meet the mesh; rows from SUMS on are zero. */
static void fill_block(const World *world, Block *block, int64_t first, int count, int rows) {
  real before[PACKET];
  int32_t none[PACKET];
  block->steps = 0;
  for (int i = 0; i < PACKET; i++) before[i] = -INFINITY, none[i] = -1;
  for (int i = 0; i < count; i++) load_ray(&world->rays, first + i, block->rays + i);
  for (int i = 0; i < count; i += PACKET) {
    int m = count - i < PACKET ? count - i : PACKET;
    search(&world->mesh, &world->tree, m, block->rays + i, block->entries + i, before, none);
  }
  Lanes *lanes = &block->lanes;
  int n = 0;
  lanes->leads = lanes->cuts = 0;
  const real *bounds = world->rays.bounds;
  for (int i = 0; i < count; i++) {
    lanes->integer[SLOT][n] = i;
    for (int k = 0; k < 3; k++)
      lanes->row[NEAR + k][n] = bounds ? bounds[k * world->rays.count + first + i] : k ? INFINITY : 0;
    if (!enter(world, block, n)) continue;
    const Ray *ray = block->rays + i;
    real numbers[] = {ray->origin[0], ray->origin[1], ray->origin[2], ray->x_high, ray->x_rest,
                      ray->x_low, ray->y_high, ray->y_rest, ray->y_low, ray->sign,
                      world->rays.numbers[8 * world->rays.count + first + i]};
    for (int k = 0; k < 11; k++) lanes->row[ORIGIN + k][n] = numbers[k];
    for (int k = SUMS; k < rows; k++) lanes->row[k][n] = 0;
    for (int k = 0; k < 3; k++) lanes->integer[AXES + k][n] = ray->axis[k];
    lanes->integer[RAY][n] = (int32_t)(first + i);
    lanes->integer[SLAB][n] = 0;
    lanes->integer[LOST][n] = 0;
    n++;
  }
  block->n = n;
}

/* The entry face with its own cell's scalars, where those behind the face may differ. */
static void reload_values(const Mesh *mesh, Lanes *lanes, int n) {
  for (int i = 0; i < n; i++) {
    int word = lanes->integer[NEXT][i];
    if (mesh->location == AT_POINTS && !(word & 8)) continue;
    int cell = word >> 4, corner = word & 3;
    real x[3], y[3], w[3], s[3], of_b, of_c;
    for (int v = 0; v < 3; v++) {
      int k = entry_corner(corner, v);
      s[v] = value_at(mesh, cell, k, point_at(mesh, cell, k));
      lanes->row[FACE + v * VERTEX + VVALUE][i] = s[v];
      x[v] = lanes->row[FACE + v * VERTEX + VX][i], y[v] = lanes->row[FACE + v * VERTEX + VY][i];
      w[v] = lanes->row[WEIGHT + v][i];
    }
    shares(x, y, w, &of_b, &of_c);
    lanes->row[VALUE][i] = s[0] + (of_b * (s[1] - s[0]) + of_c * (s[2] - s[0]));
    lanes->integer[FRESH][i] = 1;
  }
}

/* What lies behind the eye is cut off: returns the length in units of depth. Conditions are masks:
 * of `sides` and truth values GCC 12 makes selections between truth values, and then it does not
 * vectorise the loop round them. */
INLINE real clip_at_eye(real z0, real z1, real chord, real *front, real *back, int32_t *sides) {
  word_t behind0 = MASK(z0 < 0), behind1 = MASK(z1 < 0), cuts = behind0 ^ behind1;
  real whole = PICK(cuts, z1 - z0, 1);
  real at_eye = *front + (*back - *front) * (-z0 / whole);
  *front = PICK(cuts & behind0, at_eye, *front);
  *back = PICK(cuts & behind1, at_eye, *back);
  *sides = (int32_t)((behind0 & 1) | (behind1 & 2));
  real kept = PICK(behind0, 0, chord);
  return PICK(cuts, most(z0, z1), kept);
}

/* Where a segment from z0 to z1 with ends on these sides is cut: whether at its front and at its
 * back, the depths there (its own where it is not), and whether it runs backwards if it is cut. */
typedef struct {
  int front, back, outside, backwards;
  real from, to;
} Bounded;

INLINE Bounded bounded_by(real z0, real z1, real near, real far, int sides) {
  int before0 = sides & 1, before1 = (sides >> 1) & 1, beyond0 = (sides >> 2) & 1, beyond1 = sides >> 3;
  int outside = (before0 & before1) | (beyond0 & beyond1);
  int front = (before0 | beyond0) & !outside, back = (before1 | beyond1) & !outside;
  real from = before0 ? near : far, to = before1 ? near : far;
  Bounded out = {front, back, outside, before1 | beyond0, front ? from : z0, back ? to : z1};
  return out;
}

/* The same with what lies outside of near and far: `_within` of trace/local.py. */
INLINE real clip_to(real near, real far, real z0, real z1, real chord, real *front, real *back,
                    int32_t *sides) {
  int before0 = z0 < near, before1 = z1 < near, beyond0 = z0 > far, beyond1 = z1 > far;
  *sides = before0 | (before1 << 1) | (beyond0 << 2) | (beyond1 << 3);
  Bounded cut = bounded_by(z0, z1, near, far, *sides);
  real whole = (cut.front | cut.back) & (z0 != z1) ? z1 - z0 : 1, change = *back - *front;
  real first = *front + change * ((cut.from - z0) / whole);
  real last = *front + change * ((cut.back ? cut.to - z0 : 0) / whole);
  *back = cut.back ? last : *back;
  *front = cut.front ? first : *front;
  real seen = cut.backwards ? cut.from - cut.to : cut.to - cut.from;
  real kept = cut.outside ? 0 : chord;
  return cut.front | cut.back ? seen : kept;
}

/* Barycentric coordinates of exits by rays that lie in the exit face's plane. */
static void exits_on_edge(Lanes *lanes, int n) {
  for (int i = 0; i < n; i++) {
    real w[3] = {lanes->row[LEAVE][i], lanes->row[LEAVE + 1][i], lanes->row[LEAVE + 2][i]};
    if (w[0] + w[1] + w[2] != 0) continue;
    int drop = lanes->integer[DROP][i], rows[3] = {drop == 0 ? B : A, drop == 2 ? B : C, APEX};
    real x[3], y[3];
    for (int v = 0; v < 3; v++)
      x[v] = lanes->row[rows[v] + VX][i], y[v] = lanes->row[rows[v] + VY][i];
    shares(x, y, w, &lanes->row[OF_B][i], &lanes->row[OF_C][i]);
  }
}

/* How far behind the depth reached an exit may lie by rounding: see trace/local.py, make_segment. */
#define ROUNDING (16 * (real)REAL_EPS)

/* From where the lanes have come to up to their exits. leads: whether any LEAD is not 0; returns
 * whether any is now. bounded: whether rays have bounds. */
INLINE word_t segments_by(Lanes *lanes, int n, const int leads, const int bounded) {
  real(*row)[LANES] = lanes->row;
  int32_t(*integer)[LANES] = lanes->integer;
  word_t any = 0;
  LANES_LOOP
  for (int i = 0; i < n; i++) {
    int drop = integer[DROP][i], turned = (integer[WORD][i] >> 2) & 1;
    int from_b = drop == 0, to_b = drop == 2;
    real az = from_b ? row[B + VZ][i] : row[A + VZ][i];
    real al = from_b ? row[B + VLOW][i] : row[A + VLOW][i];
    real av = from_b ? row[B + VVALUE][i] : row[A + VVALUE][i];
    real bz = to_b ? row[B + VZ][i] : row[C + VZ][i];
    real bl = to_b ? row[B + VLOW][i] : row[C + VLOW][i];
    real bv = to_b ? row[B + VVALUE][i] : row[C + VVALUE][i];
    real z, z_low, value, d0 = row[DEPTH][i], d1 = row[DEPTH + 1][i];
    crossing(az, al, av, bz, bl, bv, row[APEX + VZ][i], row[APEX + VLOW][i],
             row[APEX + VVALUE][i], row[OF_B][i], row[OF_C][i], &z, &z_low, &value);
    real advance = (z - d0) + (z_low - d1), chord = turned ? -advance : advance;
    int proper = chord > 0;
    real e0 = proper ? z : d0, e1 = proper ? z_low : d1;
    real front = row[VALUE][i], back = value, last = row[BACK][i];
    if (leads) {
      real lead = row[LEAD][i], whole = lead + advance;
      int cut = proper & (lead != 0), same = integer[REACHED][i];
      real share = least(most(lead / (whole == 0 ? 1 : whole), 0), 1);
      front = cut ? front + (value - front) * share : front;
      row[CUT][i] = lead;
      integer[CUT_AT][i] = same;
      integer[REACHED][i] = lead == 0 ? integer[WORD][i] : same;
    }
    word_t late = MASK(chord <= -ROUNDING);
    real left = PICK(late, -advance, 0);
    any |= late;
    real z0 = d0 + d1, z1 = e0 + e1, kept = proper ? chord : 0, length;
    if (bounded)
      length = clip_to(row[NEAR][i], row[FAR][i], z0, z1, kept, &front, &back, &integer[SIDES][i]);
    else length = clip_at_eye(z0, z1, kept, &front, &back, &integer[SIDES][i]);
    row[DEPTH][i] = e0;
    row[DEPTH + 1][i] = e1;
    row[LEAD][i] = left;
    row[FRONT][i] = front;
    row[BACK][i] = back;
    row[LENGTH][i] = integer[LOST][i] ? 0 : length * row[STRETCH][i];
    row[VALUE][i] = value;
    integer[FRESH][i] |= front != last;
  }
  for (int i = 0; any && !leads && i < n; i++) integer[REACHED][i] = integer[WORD][i];
  return any;
}

static word_t segments(Lanes *lanes, int n, int bounded) {
  if (bounded) return lanes->leads ? segments_by(lanes, n, 1, 1) : segments_by(lanes, n, 0, 1);
  return lanes->leads ? segments_by(lanes, n, 1, 0) : segments_by(lanes, n, 0, 0);
}

/* The fourth vertex of each lane's new cell, the exit, and the segment. */
static void arrive(const World *world, Lanes *lanes, int n) {
  const Mesh *mesh = &world->mesh;
  real(*row)[LANES] = lanes->row;
  int32_t(*integer)[LANES] = lanes->integer;
  const real *restrict vertices = mesh->vertices;
  const int32_t *restrict cells = mesh->cells;
  if (mesh->location != AT_POINTS || mesh->seams) reload_values(mesh, lanes, n);
  /* One kind of access at a time, so that as many as possible wait for memory together; and what
   * `leave` will want, while there is other work. */
  uint32_t points = (uint32_t)mesh->points;
  int broken = 0;
  LANES_LOOP
  for (int i = 0; i < n; i++) {
    int word = integer[NEXT][i];
    int point = cells[4 * (word >> 4) + (word & 3)], astray = (uint32_t)point >= points;
    integer[POINT][i] = astray ? 0 : point;
    integer[WORD][i] = word;
    broken |= astray;
  }
  if (broken) is_broken(mesh->watch);
  for (int i = 0; i < n; i++) __builtin_prefetch(vertices + 4 * (int64_t)integer[POINT][i]);
  for (int i = 0; i < n; i++)
    __builtin_prefetch(mesh->neighbors + 4 * (int64_t)(integer[WORD][i] >> 4));
  LANES_LOOP
  for (int i = 0; i < n; i++) {
    int point = integer[POINT][i];
    real px = vertices[4 * point + integer[AXES][i]];
    real py = vertices[4 * point + integer[AXES + 1][i]];
    real pz = vertices[4 * point + integer[AXES + 2][i]];
    row[APEX + VVALUE][i] = vertices[4 * point + 3];
    shear(px, py, pz, row[ORIGIN][i], row[ORIGIN + 1][i], row[ORIGIN + 2][i], row[SHEAR_X][i],
          row[SHEAR_X + 1][i], row[SHEAR_X + 2][i], row[SHEAR_Y][i], row[SHEAR_Y + 1][i],
          row[SHEAR_Y + 2][i], row[SIGN][i], &row[APEX + VX][i], &row[APEX + VY][i],
          &row[APEX + VZ][i], &row[APEX + VLOW][i]);
  }
  if (mesh->location != AT_POINTS)
    for (int i = 0; i < n; i++) {
      int word = integer[WORD][i];
      row[APEX + VVALUE][i] = value_at(mesh, word >> 4, word & 3, 0);
    }
  word_t on_edge = 0;
  LANES_LOOP
  for (int i = 0; i < n; i++) {
    word_t corner = integer[WORD][i] & 3, negative = MASK(integer[POSITIVE][i] == 0), sa, sb, sc;
    real dx = row[APEX + VX][i], dy = row[APEX + VY][i];
    real wa = edge(row[A + VX][i], row[A + VY][i], dx, dy, MASK(corner > 0), &sa);
    real wb = edge(row[B + VX][i], row[B + VY][i], dx, dy, MASK(corner > 1), &sb);
    real wc = edge(row[C + VX][i], row[C + VY][i], dx, dy, MASK(corner > 2), &sc);
    sa ^= negative, sb ^= negative, sc ^= negative; /* the sign is that of the entry face */
    word_t drop_a = sc & ~sb, drop_b = ~drop_a & sa & ~sc, drop_c = ~(drop_a | drop_b);
    real first = PICK(drop_c, wb, wc), second = PICK(drop_a, wb, wa);
    real kept = PICK(drop_a, row[WEIGHT][i], PICK(drop_b, row[WEIGHT + 1][i], row[WEIGHT + 2][i]));
    real sum = (first + second) + kept, inverse = 1 / (sum == 0 ? 1 : sum);
    integer[LOST][i] = (int32_t)(~(sa ^ sb) & ~(sb ^ sc));
    integer[DROP][i] = (int32_t)((drop_b & 1) | (drop_c & 2));
    row[LEAVE][i] = first;
    row[LEAVE + 1][i] = second;
    row[LEAVE + 2][i] = kept;
    row[OF_B][i] = second * inverse;
    row[OF_C][i] = kept * inverse;
    on_edge |= MASK(sum == 0);
  }
  if (on_edge) exits_on_edge(lanes, n);
  word_t behind = segments(lanes, n, world->rays.bounds != NULL);
  lanes->cuts = lanes->leads;
  lanes->leads = behind != 0;
}

/* Through the exit face into the neighbour: names and selections. */
static void leave(const Mesh *mesh, Lanes *lanes, int n) {
  real(*row)[LANES] = lanes->row;
  int32_t(*integer)[LANES] = lanes->integer;
  const int32_t *restrict neighbors = mesh->neighbors;
  LANES_LOOP
  for (int i = 0; i < n; i++) {
    int word = integer[WORD][i], corner = word & 3, drop = integer[DROP][i];
    int exit = drop + (corner <= drop), place = corner - (corner > drop);
    int next = neighbors[4 * (word >> 4) + exit];
    int first = place == 0, last = place == 2, from_b = drop == 0, to_b = drop == 2;
    integer[NEXT][i] = integer[LOST][i] ? -1 : next;
    integer[POSITIVE][i] ^= ((corner + exit) & 1) == 0;
    integer[FRESH][i] = 0;
    for (int k = 0; k < VERTEX; k++) {
      real a = row[A + k][i], b = row[B + k][i], c = row[C + k][i], d = row[APEX + k][i];
      real p = from_b ? b : a, q = to_b ? b : c, middle = last ? q : d;
      row[A + k][i] = first ? d : p;
      row[B + k][i] = first ? p : middle;
      row[C + k][i] = last ? d : q;
    }
    real p = row[LEAVE][i], q = row[LEAVE + 1][i], d = row[LEAVE + 2][i], middle = last ? q : d;
    row[WEIGHT][i] = first ? d : p;
    row[WEIGHT + 1][i] = first ? p : middle;
    row[WEIGHT + 2][i] = last ? d : q;
  }
}

/* Whether a block has rays to be moved, and is not to end early: see watch.h. */
static inline int goes_on(const World *world, Block *block) {
  Watch *watch = world->mesh.watch;
  if (block->n && ++block->steps > world->mesh.count) is_broken(watch);
  return block->n && !is_over(watch);
}

/* Whether a lane needs nothing more: its optical depth has reached `enough`. */
static inline word_t is_opaque(const Lanes *lanes, int i, real enough) {
  return MASK(lanes->row[SUMS][i] - lanes->row[SUMS + 4][i] >= enough);
}

/* Whether a lane has come farther on its path than where anything is seen. */
static inline word_t is_through(const Lanes *lanes, int i) {
  return MASK(lanes->row[DEPTH][i] + lanes->row[DEPTH + 1][i] > lanes->row[STOP][i]);
}

/* Lanes that left the mesh, or are through, enter again, or are handed to `done` and make room; so
 * do those that are opaque. */
static void settle(const World *world, Block *block, int rows, real enough,
                   void (*done)(void *, Lanes *, int), void *data) {
  Lanes *lanes = &block->lanes;
  uint32_t cells = (uint32_t)world->mesh.count;
  word_t any = 0;
  LANES_LOOP
  for (int i = 0; i < block->n; i++) {
    /* A cell that is not there, and the outside: both are no cell. */
    word_t out = MASK((uint32_t)(lanes->integer[NEXT][i] >> 4) >= cells);
    any |= out | is_opaque(lanes, i, enough) | is_through(lanes, i);
  }
  for (int i = block->n - 1; any && i >= 0; i--) {
    int ended = is_opaque(lanes, i, enough) != 0;
    int next = lanes->integer[NEXT][i] >> 4;
    if ((uint32_t)next < cells && !ended && !is_through(lanes, i)) continue;
    if (next != -1 && (uint32_t)next >= cells) is_broken(world->mesh.watch);
    if (!ended && !lanes->integer[LOST][i] && enter(world, block, i)) continue;
    done(data, lanes, i);
    move_lane(lanes, rows, --block->n, i);
  }
}

#endif
