/* Derivatives, front to back as in adjoint/replay.py: of pieces by their slab's control points and
 * by their segment (optics/integrator.py), and of segments by their cell and ray (trace/local.py). */
#ifndef JAXVR_PULL_H
#define JAXVR_PULL_H

#include "scene.h"
#include "shade.h"
#include "walk.h"

/* Composites m pieces and takes the pixel's cotangent back to TBAR, the ends of the lanes' slabs,
 * and to SBAR, the segments. */
INLINE void pull_pieces(Lanes *lanes, const Pieces *p, int m, const int dense) {
  LANES_LOOP
  for (int j = 0; j < m; j++) {
    int i = dense ? j : p->lane[j];
    real through = exp_minus(lanes->row[SUMS][i], lanes->row[SUMS + 4][i]);
    real length = p->length[j], w = p->w[j], w_back = p->w_back[j];
    real tau_front = p->front[0][j], tau_back = tau_front + p->change[0][j];
    real a = p->a[j], b = p->b[j];
    real sum = lanes->row[SUMS][i], excess = lanes->row[SUMS + 4][i];
    add_to(&sum, &excess, (real)0.5 * (a + b));
    lanes->row[SUMS][i] = sum;
    lanes->row[SUMS + 4][i] = excess;
    /* PIXEL + 3 holds the cotangent of the optical depth. */
    real depth_bar = lanes->row[PIXEL + 3][i], w_bar = 0, w_back_bar = 0;
    real front_bar[4], back_bar[4];
    for (int c = 1; c < 4; c++) {
      real light = p->front[c][j] * w + p->change[c][j] * w_back;
      sum = lanes->row[SUMS + c][i], excess = lanes->row[SUMS + 4 + c][i];
      add_to(&sum, &excess, through * light);
      lanes->row[SUMS + c][i] = sum;
      lanes->row[SUMS + 4 + c][i] = excess;
      real behind = (lanes->row[FINAL + c][i] - sum) - (lanes->row[FINAL + 4 + c][i] - excess);
      real pixel = lanes->row[PIXEL + c - 1][i], light_bar = through * pixel;
      depth_bar -= pixel * behind;
      w_bar += light_bar * p->front[c][j];
      w_back_bar += light_bar * p->change[c][j];
      front_bar[c] = light_bar * (w - w_back);
      back_bar[c] = light_bar * w_back;
    }
    real half = (real)0.5 * transmittance(a, b), shared = half * w_bar + (real)0.5 * depth_bar;
    real by_b = half - (real)0.5 * p->b2[j], by_a = by_b - (real)0.5 * p->b1[j];
    real a_bar = shared + by_a * w_back_bar, b_bar = shared + by_b * w_back_bar;
    front_bar[0] = a_bar * length;
    back_bar[0] = b_bar * length;
    real place0 = p->place[0][j], place1 = p->place[1][j], t0 = p->t[0][j], t1 = p->t[1][j];
    real move0 = 0, move1 = 0;
    for (int c = 0; c < 4; c++) {
      real across = lanes->row[RECORD + CHANGE + c][i];
      move0 += front_bar[c] * across;
      move1 += back_bar[c] * across;
      lanes->row[TBAR + 1 + c][i] += front_bar[c] * (1 - place0) + back_bar[c] * (1 - place1);
      lanes->row[TBAR + 6 + c][i] += front_bar[c] * place0 + back_bar[c] * place1;
    }
    /* `_moving` of optics/partition.py: soft ends move in the slab, hard ones take the share along. */
    real along = a_bar * tau_front + b_bar * tau_back, share_bar = along * lanes->row[LENGTH][i];
    move0 = move0 * p->slope[0][j] - share_bar * p->rate[0][j];
    move1 = move1 * p->slope[1][j] - share_bar * p->rate[1][j];
    lanes->row[TBAR][i] -= (move0 * (1 - place0) + move1 * (1 - place1));
    lanes->row[TBAR + 5][i] -= (move0 * place0 + move1 * place1);
    lanes->row[SBAR][i] += move0 * (1 - t0) + move1 * (1 - t1);
    lanes->row[SBAR + 1][i] += move0 * t0 + move1 * t1;
    lanes->row[SBAR + 2][i] += along * p->fraction[j];
  }
}

/* All pieces of the lanes' segments. table: see `hand_in`, or NULL if it is not asked for. */
static void pull_shading(const Transfer *tf, const Rule *rule, Lanes *lanes, int n,
                         double *table) {
  Pieces p;
  for (int k = 0; k < 3; k++) memset(lanes->row[SBAR + k], 0, n * sizeof(real));
  int m = begin_segments(tf, lanes, n, 1, p.lane, table);
  while (m > 0) {
    int dense = m == n;
    cut(lanes, &p, m, dense, 1);
    integrate(rule, &p, m);
    if (dense) pull_pieces(lanes, &p, m, 1);
    else pull_pieces(lanes, &p, m, 0);
    m = go_on(tf, lanes, &p, m, dense, table);
  }
}

/* Gradient over the projected face of what is linear on it, from differences to its first vertex. */
INLINE void slopes(real to_b, real to_c, real ux, real uy, real vx, real vy, real per_area, real *x,
                   real *y) {
  *x = (to_b * vy - to_c * uy) * per_area;
  *y = (ux * to_c - vx * to_b) * per_area;
}

typedef struct { real x, y, z, s; } Pulled;

/* Cotangents of a crossing, for the whole face; area is twice its signed area. */
INLINE Pulled pull_crossing(const real a[VERTEX], const real b[VERTEX], const real c[VERTEX],
                            real area, real z_bar, real s_bar) {
  real ux = b[VX] - a[VX], uy = b[VY] - a[VY], vx = c[VX] - a[VX], vy = c[VY] - a[VY];
  real per_area = area == 0 ? 0 : 1 / (area == 0 ? 1 : area), zx, zy, sx, sy;
  slopes((b[VZ] - a[VZ]) + (b[VLOW] - a[VLOW]), (c[VZ] - a[VZ]) + (c[VLOW] - a[VLOW]), ux, uy, vx,
         vy, per_area, &zx, &zy);
  slopes(b[VVALUE] - a[VVALUE], c[VVALUE] - a[VVALUE], ux, uy, vx, vy, per_area, &sx, &sy);
  Pulled q = {-(z_bar * zx + s_bar * sx), -(z_bar * zy + s_bar * sy), z_bar, s_bar};
  return q;
}

/* Cotangents of the four vertices of the lanes' cells, a, b, c and the apex: x, y, z in the ray's
 * axes, and the scalar. start: of the depth where a segment starts that is cut off at one. */
typedef struct {
  _Alignas(64) real of[4][4][LANES], share[2][LANES], start[LANES];
} CellBar;

/* Shares of b and c in the entry crossings. */
static void entry_shares(Lanes *lanes, int n, real share[2][LANES]) {
  real(*row)[LANES] = lanes->row;
  word_t flat = 0;
  LANES_LOOP
  for (int i = 0; i < n; i++) {
    real sum = (row[WEIGHT][i] + row[WEIGHT + 1][i]) + row[WEIGHT + 2][i];
    real inverse = 1 / (sum == 0 ? 1 : sum);
    share[0][i] = row[WEIGHT + 1][i] * inverse;
    share[1][i] = row[WEIGHT + 2][i] * inverse;
    flat |= MASK(sum == 0);
  }
  for (int i = 0; flat && i < n; i++) {
    real x[3] = {row[A + VX][i], row[B + VX][i], row[C + VX][i]};
    real y[3] = {row[A + VY][i], row[B + VY][i], row[C + VY][i]};
    real w[3] = {row[WEIGHT][i], row[WEIGHT + 1][i], row[WEIGHT + 2][i]};
    if (w[0] + w[1] + w[2] == 0) shares(x, y, w, &share[0][i], &share[1][i]);
  }
}

/* cuts: whether any segment may be cut off at a depth reached before, by CUT. bounded: whether rays
 * have bounds. */
INLINE void pull_cells_by(Lanes *lanes, int n, CellBar *bar, const int cuts, const int bounded) {
  real(*row)[LANES] = lanes->row;
  entry_shares(lanes, n, bar->share);
  LANES_LOOP
  for (int i = 0; i < n; i++) {
    int drop = lanes->integer[DROP][i];
    word_t drop_a = MASK(drop == 0), drop_c = MASK(drop == 2), keep_b = ~MASK(drop == 1);
    word_t turned = MASK((lanes->integer[WORD][i] & 4) != 0);
    real a[VERTEX], b[VERTEX], c[VERTEX], p[VERTEX], q[VERTEX], d[VERTEX];
    for (int k = 0; k < VERTEX; k++) {
      a[k] = row[A + k][i], b[k] = row[B + k][i], c[k] = row[C + k][i], d[k] = row[APEX + k][i];
      p[k] = PICK(drop_a, b[k], a[k]), q[k] = PICK(drop_c, b[k], c[k]);
    }
    real in_b = bar->share[0][i], in_c = bar->share[1][i], in_a = (1 - in_b) - in_c;
    real out_q = row[OF_B][i], out_d = row[OF_C][i], out_p = (1 - out_q) - out_d;
    real zi, zi_low, si, zo, zo_low, so;
    crossing(a[VZ], a[VLOW], a[VVALUE], b[VZ], b[VLOW], b[VVALUE], c[VZ], c[VLOW], c[VVALUE], in_b,
             in_c, &zi, &zi_low, &si);
    crossing(p[VZ], p[VLOW], p[VVALUE], q[VZ], q[VLOW], q[VVALUE], d[VZ], d[VLOW], d[VVALUE], out_q,
             out_d, &zo, &zo_low, &so);
    /* The segment: from its cotangents to those of the two crossings, see make_segment. It starts
     * at depth z0 with the scalar s0. */
    real front_bar = row[SBAR][i], back_bar = row[SBAR + 1][i], length_bar = row[SBAR + 2][i];
    real lead = cuts ? row[CUT][i] : 0;
    real through = (zo - zi) + (zo_low - zi_low), advance = through - lead;
    real chord = PICK(turned, -advance, advance), z0 = (zi + zi_low) + lead;
    word_t proper = MASK(chord > 0), near = MASK(chord > -ROUNDING);
    word_t cut = cuts ? MASK(lead != 0) & proper : 0;
    real place = cuts ? lead / PICK(MASK(through == 0), 1, through) : 0;
    real share = cuts ? PICK(cut, least(most(place, 0), 1), 0) : 0;
    real s0 = cuts ? si + (so - si) * share : si;
    real z1 = PICK(proper, zo + zo_low, z0);
    /* As the walk has found: made anew, depths at the eye are rounded in another way. */
    int sides = lanes->integer[SIDES][i];
    real scaled = length_bar * row[STRETCH][i], difference = so - s0, length;
    real zi_bar, zo_bar, si_bar, so_bar;
    if (bounded) {
      /* Each end that is cut lies at a depth c, where the scalar is s0 + difference t with
       * t = (c - z0) / (z1 - z0); an end of the length is c, or one of the crossings. */
      Bounded at = bounded_by(z0, z1, row[NEAR][i], row[FAR][i], sides);
      word_t cut0 = MASK(at.front), cut1 = MASK(at.back), cut_off = cut0 | cut1;
      real whole = PICK(cut_off & MASK(z0 != z1), z1 - z0, 1);
      real t0 = PICK(cut0, at.from - z0, 0) / whole, t1 = PICK(cut1, at.to - z0, 0) / whole;
      word_t backwards = MASK(at.backwards);
      length = PICK(cut_off, PICK(backwards, at.from - at.to, at.to - at.from),
                    PICK(MASK(at.outside) | ~proper, 0, chord));
      real along = PICK(MASK(at.outside) | ~near, 0, PICK(turned, -scaled, scaled));
      real onward = PICK(backwards, -scaled, scaled);
      real from_bar = PICK(cut0, front_bar * difference / whole, 0);
      real to_bar = PICK(cut1, back_bar * difference / whole, 0);
      real moved = from_bar * (1 - t0) + to_bar * (1 - t1), led = from_bar * t0 + to_bar * t1;
      zi_bar = PICK(cut_off, PICK(cut0, 0, -onward) - moved, -along);
      zo_bar = PICK(cut_off, PICK(cut1, 0, onward) - led, along);
      si_bar = PICK(cut0, front_bar * (1 - t0), front_bar) + PICK(cut1, back_bar * (1 - t1), 0);
      so_bar = PICK(cut1, back_bar * t1, back_bar) + PICK(cut0, front_bar * t0, 0);
      real at_front = PICK(cut0, from_bar - onward, 0), at_back = PICK(cut1, to_bar + onward, 0);
      word_t near0 = MASK(sides & 1), near1 = MASK((sides >> 1) & 1);
      row[RBAR + 6][i] += PICK(near0, at_front, 0) + PICK(near1, at_back, 0);
      row[RBAR + 7][i] += PICK(near0, 0, at_front) + PICK(near1, 0, at_back);
    } else {
      word_t behind0 = MASK((sides & 1) != 0), behind1 = MASK((sides & 2) != 0);
      word_t cut_off = behind0 ^ behind1;
      real whole = PICK(cut_off & MASK(z0 != z1), z1 - z0, 1), t = -z0 / whole;
      real kept = PICK(behind0 | ~proper, 0, chord);
      length = PICK(cut_off, PICK(behind0, z1, z0), kept);
      real along = PICK(behind0 | ~near, 0, PICK(turned, -scaled, scaled));
      real cut_bar = PICK(behind0, front_bar, back_bar); /* of the scalar at the eye */
      real t_bar = cut_bar * difference / (whole * whole);
      zi_bar = PICK(cut_off, PICK(behind0, 0, scaled) - t_bar * z1, -along);
      zo_bar = PICK(cut_off, PICK(behind0, scaled, 0) + t_bar * z0, along);
      real si_cut = PICK(behind0, front_bar * (1 - t), front_bar + back_bar * (1 - t));
      real so_cut = PICK(behind0, back_bar + front_bar * t, back_bar * t);
      si_bar = PICK(cut_off, si_cut, front_bar), so_bar = PICK(cut_off, so_cut, back_bar);
    }
    if (cuts) {
      /* s0 = si + (so - si) share, share = (z0 - zi) / (zo - zi), and z0 is another face's. */
      word_t inside = cut & MASK(place > 0) & MASK(place < 1);
      real slope = PICK(inside, si_bar * (so - si) / PICK(inside, through, 1), 0);
      word_t led = MASK(lead != 0);
      bar->start[i] = PICK(led, zi_bar + slope, 0);
      zi_bar = PICK(led, -slope * (1 - share), zi_bar);
      zo_bar -= slope * share;
      so_bar += si_bar * share;
      si_bar -= si_bar * share;
    }
    /* The crossings: to the faces' vertices. */
    word_t positive = MASK(lanes->integer[POSITIVE][i] != 0);
    real area = (row[WEIGHT][i] + row[WEIGHT + 1][i]) + row[WEIGHT + 2][i];
    real exit_area = (row[LEAVE][i] + row[LEAVE + 1][i]) + row[LEAVE + 2][i];
    area = PICK(positive, area, -area);
    exit_area = PICK(positive ^ ~keep_b, exit_area, -exit_area);
    Pulled in = pull_crossing(a, b, c, area, zi_bar, si_bar);
    Pulled out = pull_crossing(p, q, d, exit_area, zo_bar, so_bar);
    real sx = row[SHEAR_X][i] + row[SHEAR_X + 1][i], sy = row[SHEAR_Y][i] + row[SHEAR_Y + 1][i];
    real sign = row[SIGN][i];
    real in_z = sign * in.z - sx * in.x - sy * in.y, out_z = sign * out.z - sx * out.x - sy * out.y;
    real from_in[4] = {in_a, in_b, in_c, 0};
    real from_out[4] = {PICK(drop_a, 0, out_p), PICK(drop_a, out_p, PICK(drop_c, out_q, 0)),
                        PICK(drop_c, 0, out_q), out_d};
    for (int v = 0; v < 4; v++) {
      bar->of[v][0][i] = from_in[v] * in.x + from_out[v] * out.x;
      bar->of[v][1][i] = from_in[v] * in.y + from_out[v] * out.y;
      bar->of[v][2][i] = from_in[v] * in_z + from_out[v] * out_z;
      bar->of[v][3][i] = from_in[v] * in.s + from_out[v] * out.s;
    }
    row[RBAR][i] -= in.x + out.x;
    row[RBAR + 1][i] -= in.y + out.y;
    row[RBAR + 2][i] -= in_z + out_z;
    row[RBAR + 3][i] -= sign * (in.x * zi + out.x * zo);
    row[RBAR + 4][i] -= sign * (in.y * zi + out.y * zo);
    row[RBAR + 5][i] += length_bar * length;
  }
}

/* Sums over a group of blocks, and which chunks of CHUNK numbers have been added to. */
#define CHUNK 64
typedef struct {
  real *sum;
  char *touched;
  int64_t size; /* of sum */
} Part;

static void pull_cells(Lanes *lanes, int n, CellBar *bar, int bounded) {
  if (bounded && lanes->cuts) pull_cells_by(lanes, n, bar, 1, 1);
  else if (bounded) pull_cells_by(lanes, n, bar, 0, 1);
  else if (lanes->cuts) pull_cells_by(lanes, n, bar, 1, 0);
  else pull_cells_by(lanes, n, bar, 0, 0);
}

/* Takes the cotangents of depths where segments were cut off to the faces that those are of. */
static void pull_starts(const Mesh *mesh, Block *block, const CellBar *bar, Part *vertices) {
  Lanes *lanes = &block->lanes;
  for (int i = 0; lanes->cuts && i < block->n; i++) {
    if (lanes->row[CUT][i] == 0 || bar->start[i] == 0 || lanes->integer[LOST][i]) continue;
    const Ray *ray = block->rays + lanes->integer[SLOT][i];
    int word = lanes->integer[CUT_AT][i], cell = word >> 4, corner = word & 3;
    FaceSeen face;
    see_face(mesh, ray, cell, corner, &face);
    real area = (face.weight[0] + face.weight[1]) + face.weight[2], x[3], y[3], of[3];
    for (int v = 0; v < 3; v++) x[v] = face.vertex[v][VX], y[v] = face.vertex[v][VY];
    shares(x, y, face.weight, &of[1], &of[2]);
    of[0] = (1 - of[1]) - of[2];
    Pulled q = pull_crossing(face.vertex[0], face.vertex[1], face.vertex[2],
                             face.positive ? area : -area, bar->start[i], 0);
    real sx = ray->x_high + ray->x_rest, sy = ray->y_high + ray->y_rest;
    real in_space[3] = {q.x, q.y, ray->sign * q.z - sx * q.x - sy * q.y};
    for (int k = 0; k < 3; k++) {
      lanes->row[RBAR + k][i] -= in_space[k];
      for (int v = 0; vertices->sum && v < 3; v++) {
        int point = point_at(mesh, cell, entry_corner(corner, v));
        vertices->sum[4 * (int64_t)point + ray->axis[k]] += of[v] * in_space[k];
        vertices->touched[point / (CHUNK / 4)] = 1;
      }
    }
    lanes->row[RBAR + 3][i] -= ray->sign * q.x * face.z;
    lanes->row[RBAR + 4][i] -= ray->sign * q.y * face.z;
  }
}

/* To where they came from. vertices (P, 4): coordinates, and scalars at points; values: others. */
static void scatter_cells(const Mesh *mesh, const Lanes *lanes, int n, const CellBar *bar,
                          Part *vertices, Part *values) {
  for (int i = 0; i < n; i++) {
    if (lanes->integer[LOST][i]) continue;
    int word = lanes->integer[WORD][i], cell = word >> 4, corner = word & 3;
    for (int v = 0; v < 4; v++) {
      int at = v < 3 ? entry_corner(corner, v) : corner;
      int id = point_at(mesh, cell, at);
      real *point = vertices->sum + 4 * (int64_t)id;
      vertices->touched[id / (CHUNK / 4)] = 1;
      for (int k = 0; k < 3; k++) point[lanes->integer[AXES + k][i]] += bar->of[v][k][i];
      real of_value = bar->of[v][3][i];
      if (mesh->location == AT_POINTS) {
        point[3] += of_value;
        continue;
      }
      int64_t slot = mesh->location == AT_CELLS ? cell : 4 * (int64_t)cell + at;
      values->sum[slot] += of_value;
      values->touched[slot / CHUNK] = 1;
    }
  }
}

#endif
