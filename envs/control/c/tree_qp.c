/* The quadratic program of a scenario tree, solved by HPIPM (Frison and Diehl, IFAC-PapersOnLine 53(2), 2020) by a Riccati recursion
   over the tree:

       minimise over du, dx   sum over nodes i > 0        q_i'dx_i + dx_i' (H_i)+ dx_i / 2 + price_i' (violation of the state bounds)
                            + sum over nodes with children  c_i' (moved_i + du_i - du_parent(i))^2 - c_i' moved_i^2
       subject to             dx_i = A_i dx_parent(i) + B_i du_parent(i),   dx_0 = 0, du_parent(0) = 0,   u_low_i <= du_i <= u_high_i

   (H)+ is the projection of a symmetric matrix to positive semidefinite ones. */

#include "tree_qp.h"

#include <stdint.h>
#include <string.h>

#include <hpipm_tree.h>
#ifdef RL_MPC_SINGLE
#include <hpipm_s_tree_ocp_qp.h>
#include <hpipm_s_tree_ocp_qp_dim.h>
#include <hpipm_s_tree_ocp_qp_ipm.h>
#include <hpipm_s_tree_ocp_qp_sol.h>
#define HPIPM(name) s_tree_ocp_qp##name
#define RIDGE 1e-6f     /* on du, so that an action that no cost depends on has a solution */
#define DIAGONAL 1e-12f /* share of squares off the diagonal of a matrix that counts as diagonal */
#else
#include <hpipm_d_tree_ocp_qp.h>
#include <hpipm_d_tree_ocp_qp_dim.h>
#include <hpipm_d_tree_ocp_qp_ipm.h>
#include <hpipm_d_tree_ocp_qp_sol.h>
#define HPIPM(name) d_tree_ocp_qp##name
#define RIDGE 1e-8
#define DIAGONAL 1e-26
#endif

#if defined __FAST_MATH__ || (defined __FINITE_MATH_ONLY__ && __FINITE_MATH_ONLY__)
#error "compile tree_qp.c without -ffast-math: not-a-number must stay what it is"
#endif

#define ALIGNMENT 64
#define ARGUMENTS 256 /* bytes that HPIPM's arguments may take; none at present */

struct tree_qp {
  tree_qp_shape shape;
  struct tree tree;
  struct HPIPM(_dim) dim;
  struct HPIPM() qp;
  struct HPIPM(_sol) sol;
  struct HPIPM(_ipm_arg) arg;
  struct HPIPM(_ipm_ws) ws;
  real *scratch, *positive, *dx; /* (H)+ and dx of every edge */
  int *index;
};

static uintptr_t aligned(void *memory) { return ((uintptr_t)memory + ALIGNMENT - 1) / ALIGNMENT * ALIGNMENT; }

/* the next so many bytes; where memory begins at 0 they are only counted */
static void *take(uintptr_t *memory, size_t bytes) {
  const uintptr_t at = *memory;
  *memory += (bytes + ALIGNMENT - 1) / ALIGNMENT * ALIGNMENT;
  return (void *)at;
}

/* size of a node's state: of nodes with children the action before belongs to it, if its change has a price */
static int size(const tree_qp_shape *shape, int node) {
  return node == 0 ? 0 : shape->nx + (shape->changes && node < shape->inner ? shape->nu : 0);
}

/* bytes that `describe` takes */
static size_t description(size_t nodes) {
  uintptr_t at = 0;
  take(&at, nodes * sizeof(struct node)), take(&at, nodes * sizeof(int)), take(&at, 6 * nodes * sizeof(int));
  take(&at, HPIPM(_dim_memsize)(nodes)), take(&at, ARGUMENTS);
  return at;
}

/* what HPIPM has to know before it can tell the size of the rest */
static void describe(tree_qp *self, uintptr_t memory) {
  tree_qp_shape *shape = &self->shape;
  real *tolerance = &shape->tolerance;
  const int n = shape->nodes, inner = shape->inner, nu = shape->nu, rows = shape->rows;
  struct node *node = take(&memory, n * sizeof *node);
  int *kids = take(&memory, n * sizeof *kids), *number = take(&memory, 6 * n * sizeof *number), at = 0, none = 0;
  memset(node, 0, n * sizeof *node);
  for (int i = 0; i < n; i++) {
    node[i].idx = i, node[i].dad = shape->parent[i], node[i].stage = shape->stage[i], node[i].kids = kids + at;
    for (int k = i + 1; k < n; k++)
      if (shape->parent[k] == i) node[k].idxkid = node[i].nkids++, kids[at++] = k;
    const int of[6] = {size(shape, i), i < inner ? nu : 0, i ? rows : 0, i < inner ? nu : 0, 0, i ? rows : 0};
    for (int k = 0; k < 6; k++) number[k * n + i] = of[k]; /* states, actions, bounds on each, general ones, slacks */
  }
  self->tree.root = node, self->tree.kids = kids, self->tree.Nn = n;
  HPIPM(_dim_create)(n, &self->dim, take(&memory, HPIPM(_dim_memsize)(n)));
  HPIPM(_dim_set_all)(&self->tree, number, number + n, number + 2 * n, number + 3 * n, number + 4 * n, number + 5 * n, &self->dim);
  HPIPM(_ipm_arg_create)(&self->dim, &self->arg, take(&memory, ARGUMENTS));
  HPIPM(_ipm_arg_set_default)(SPEED_ABS, &self->arg);
  HPIPM(_ipm_arg_set_comp_res_exit)(&none, &self->arg); /* both are left to chance by the defaults */
  HPIPM(_ipm_arg_set_comp_dual_sol_eq)(&none, &self->arg);
  HPIPM(_ipm_arg_set_iter_max)(&shape->most, &self->arg);
  HPIPM(_ipm_arg_set_tol_stat)(tolerance, &self->arg);
  HPIPM(_ipm_arg_set_tol_eq)(tolerance, &self->arg);
  HPIPM(_ipm_arg_set_tol_ineq)(tolerance, &self->arg);
  HPIPM(_ipm_arg_set_tol_comp)(tolerance, &self->arg);
}

/* where everything is, and the end of it */
static uintptr_t arrange(tree_qp *self, uintptr_t memory, void **qp, void **sol, void **ws) {
  const tree_qp_shape *shape = &self->shape;
  const size_t nx = shape->nx, wide = nx + shape->nu;
  *qp = take(&memory, HPIPM(_memsize)(&self->dim));
  *sol = take(&memory, HPIPM(_sol_memsize)(&self->dim));
  *ws = take(&memory, HPIPM(_ipm_ws_memsize)(&self->dim, &self->arg));
  self->scratch = take(&memory, (4 * wide * wide + 8 * wide) * sizeof(real));
  self->positive = take(&memory, shape->nodes * nx * nx * sizeof(real));
  self->dx = take(&memory, shape->nodes * nx * sizeof(real));
  self->index = take(&memory, 2 * wide * sizeof(int));
  return memory;
}

size_t tree_qp_size(const tree_qp_shape *shape) {
  tree_qp self = {.shape = *shape};
  char head[description(shape->nodes) + ALIGNMENT];
  void *none;
  describe(&self, aligned(head));
  return ALIGNMENT + sizeof self + ALIGNMENT + description(shape->nodes) + arrange(&self, 0, &none, &none, &none);
}

tree_qp *tree_qp_init(void *memory, const tree_qp_shape *shape) {
  memset(memory, 0, tree_qp_size(shape));
  uintptr_t at = aligned(memory);
  tree_qp *self = take(&at, sizeof *self);
  void *head = take(&at, description(shape->nodes)), *qp, *sol, *ws;
  self->shape = *shape;
  describe(self, (uintptr_t)head);
  arrange(self, at, &qp, &sol, &ws);
  HPIPM(_create)(&self->dim, &self->qp, qp);
  HPIPM(_sol_create)(&self->dim, &self->sol, sol);
  HPIPM(_ipm_ws_create)(&self->dim, &self->arg, &self->ws, ws);
  /* what never changes: which variables have bounds and slacks, and that slack has no quadratic price */
  const int wide = shape->nx + shape->nu, rows = shape->rows;
  int *index = self->index, *soft = index + wide;
  for (int i = 0; i < wide; i++) index[i] = i;
  for (int i = 0; i < shape->nodes; i++) {
    if (i < shape->inner) {
      HPIPM(_set_idxbu)(i, index, &self->qp);
      if (i) HPIPM(_set_S)(i, self->scratch, &self->qp);
    }
    if (i) {
      for (int j = 0; j < rows; j++) soft[j] = (i < shape->inner ? shape->nu : 0) + j;
      HPIPM(_set_b)(i - 1, self->scratch, &self->qp);
      HPIPM(_set_idxbx)(i, (int *)shape->row, &self->qp);
      HPIPM(_set_idxs)(i, soft, &self->qp);
      HPIPM(_set_Zl)(i, self->scratch, &self->qp);
      HPIPM(_set_Zu)(i, self->scratch, &self->qp);
      HPIPM(_set_lls)(i, self->scratch, &self->qp);
      HPIPM(_set_lus)(i, self->scratch, &self->qp);
    }
  }
  return self;
}

/* by cyclic Jacobi rotations (Golub and Van Loan, section 8.5) */
void tree_qp_positive_part(int n, const real *h, real *result, real *work) {
  real *m = work, *v = work + n * n, total = 0;
  for (int i = 0; i < n * n; i++) {
    m[i] = (h[i] + h[i % n * n + i / n]) / 2;
    v[i] = i % n == i / n;
    total += m[i] * m[i];
  }
  for (int sweep = 0; sweep < 30; sweep++) {
    real off = 0;
    for (int q = 1; q < n; q++)
      for (int p = 0; p < q; p++) off += m[q * n + p] * m[q * n + p];
    if (!(off > DIAGONAL * total)) break;
    for (int q = 1; q < n; q++)
      for (int p = 0; p < q; p++) {
        if (m[q * n + p] == 0) continue;
        const real theta = (m[q * n + q] - m[p * n + p]) / (2 * m[q * n + p]);
        const real t = (theta >= 0 ? 1 : -1) / (fabs(theta) + sqrt(theta * theta + 1)), c = 1 / sqrt(t * t + 1), s = t * c;
        for (int k = 0; k < n; k++) { /* columns p and q of m and v */
          const real a = m[p * n + k], b = m[q * n + k], d = v[p * n + k], e = v[q * n + k];
          m[p * n + k] = c * a - s * b, m[q * n + k] = s * a + c * b;
          v[p * n + k] = c * d - s * e, v[q * n + k] = s * d + c * e;
        }
        for (int k = 0; k < n; k++) { /* rows p and q of m */
          const real a = m[k * n + p], b = m[k * n + q];
          m[k * n + p] = c * a - s * b, m[k * n + q] = s * a + c * b;
        }
      }
  }
  memset(result, 0, n * n * sizeof *result);
  for (int k = 0; k < n; k++) {
    if (m[k * n + k] <= 0) continue; /* what is not a number goes on */
    for (int j = 0; j < n; j++)
      for (int i = 0; i < n; i++) result[j * n + i] += m[k * n + k] * v[k * n + i] * v[k * n + j];
  }
}

/* a, (rows, columns), in the upper left corner of zeros; a itself where nothing is added */
static real *widened(const real *a, int rows, int columns, int all_rows, int all_columns, real *scratch) {
  if (rows == all_rows && columns == all_columns) return (real *)a;
  memset(scratch, 0, all_rows * all_columns * sizeof *scratch);
  for (int j = 0; j < columns; j++) memcpy(scratch + j * all_rows, a + j * rows, rows * sizeof *scratch);
  return scratch;
}

/* what is minimised, at du */
static real cost_at(tree_qp *self, const real *du, const real *A, const real *B, const real *q, const real *x_low,
                      const real *x_high, const real *price, const real *c, const real *moved) {
  const int nx = self->shape.nx, nu = self->shape.nu, rows = self->shape.rows;
  real cost = 0;
  for (int i = 0; i < self->shape.inner; i++)
    for (int k = 0; k < nu; k++) {
      const real step = du[nu * i + k] - (i ? du[nu * self->tree.root[i].dad + k] : 0);
      cost += c[nu * i + k] * (step + 2 * moved[nu * i + k]) * step;
    }
  for (int i = 1; i < self->shape.nodes; i++) {
    const int e = i - 1, dad = self->tree.root[i].dad;
    const real *H = self->positive + nx * nx * e, *before = dad ? self->dx + nx * (dad - 1) : NULL;
    real *x = self->dx + nx * e;
    for (int j = 0; j < nx; j++) {
      x[j] = 0;
      for (int k = 0; before && k < nx; k++) x[j] += A[nx * nx * e + nx * k + j] * before[k];
      for (int k = 0; k < nu; k++) x[j] += B[nx * nu * e + nx * k + j] * du[nu * dad + k];
    }
    for (int j = 0; j < nx; j++) {
      cost += q[nx * e + j] * x[j];
      for (int k = 0; k < nx; k++) cost += H[nx * k + j] * x[j] * x[k] / 2;
    }
    for (int j = 0; j < rows; j++) {
      const real at = x[self->shape.row[j]], *p = price + 2 * rows * e;
      cost += p[j] * fmax(x_low[rows * e + j] - at, 0) + p[rows + j] * fmax(at - x_high[rows * e + j], 0);
    }
  }
  return cost;
}

int tree_qp_solve(tree_qp *self, const real *A, const real *B, const real *q, const real *H, const real *u_low,
                  const real *u_high, const real *x_low, const real *x_high, const real *price, const real *c,
                  const real *moved, real barrier, real *du, real *cost, int *iterations) {
  const int nx = self->shape.nx, nu = self->shape.nu, rows = self->shape.rows, wide = nx + nu;
  real *s = self->scratch, *work = s + wide * wide;
  struct HPIPM() *qp = &self->qp;
  int status;
  for (int i = 0; i < self->shape.nodes; i++) {
    if (i < self->shape.inner) {
      HPIPM(_set_lbu)(i, (real *)u_low + nu * i, qp);
      HPIPM(_set_ubu)(i, (real *)u_high + nu * i, qp);
      memset(s, 0, nu * (nu + 1) * sizeof *s);
      for (int k = 0; k < nu; k++) s[k * nu + k] = RIDGE + 2 * c[nu * i + k], s[nu * nu + k] = 2 * c[nu * i + k] * moved[nu * i + k];
      HPIPM(_set_R)(i, s, qp);
      HPIPM(_set_r)(i, s + nu * nu, qp);
      if (i && self->shape.changes) {
        memset(s, 0, nu * wide * sizeof *s);
        for (int k = 0; k < nu; k++) s[(nx + k) * nu + k] = -2 * c[nu * i + k];
        HPIPM(_set_S)(i, s, qp);
      }
    }
    if (i == 0) continue;
    const int e = i - 1, here = size(&self->shape, i), before = size(&self->shape, self->tree.root[i].dad);
    if (before) HPIPM(_set_A)(e, widened(A + nx * nx * e, nx, nx, here, before, s), qp);
    real *b = widened(B + nx * nu * e, nx, nu, here, nu, s);
    for (int k = 0; k < here - nx; k++) b[k * here + nx + k] = 1; /* the action is the next node's action before */
    HPIPM(_set_B)(e, b, qp);
    real *positive = self->positive + nx * nx * e;
    tree_qp_positive_part(nx, H + nx * nx * e, positive, work);
    real *Q = widened(positive, nx, nx, here, here, s);
    for (int k = 0; k < here - nx; k++) Q[(nx + k) * here + nx + k] = 2 * c[nu * i + k];
    HPIPM(_set_Q)(i, Q, qp);
    real *slope = widened(q + nx * e, nx, 1, here, 1, s);
    for (int k = 0; k < here - nx; k++) slope[nx + k] = -2 * c[nu * i + k] * moved[nu * i + k];
    HPIPM(_set_q)(i, slope, qp);
    HPIPM(_set_lbx)(i, (real *)x_low + rows * e, qp);
    HPIPM(_set_ubx)(i, (real *)x_high + rows * e, qp);
    HPIPM(_set_zl)(i, (real *)price + 2 * rows * e, qp);
    HPIPM(_set_zu)(i, (real *)price + 2 * rows * e + rows, qp);
  }
  HPIPM(_ipm_arg_set_mu0)(&barrier, &self->arg);
  HPIPM(_ipm_solve)(qp, &self->sol, &self->arg, &self->ws);
  HPIPM(_ipm_get_iter)(&self->ws, iterations);
  HPIPM(_ipm_get_status)(&self->ws, &status);
  for (int i = 0; i < self->shape.inner; i++) {
    HPIPM(_sol_get_u)(i, &self->sol, du + nu * i);
    for (int k = nu * i; k < nu * (i + 1); k++) du[k] = du[k] < u_low[k] ? u_low[k] : du[k] > u_high[k] ? u_high[k] : du[k];
  }
  *cost = cost_at(self, du, A, B, q, x_low, x_high, price, c, moved);
  return status;
}

void tree_qp_multipliers(tree_qp *self, real *multipliers) {
  int wanted[2] = {1, 0};
  HPIPM(_ipm_arg_set_comp_dual_sol_eq)(wanted, &self->arg); /* a tenth of the time, which tree_qp_solve saves */
  HPIPM(_ipm_solve)(&self->qp, &self->sol, &self->arg, &self->ws);
  HPIPM(_ipm_arg_set_comp_dual_sol_eq)(wanted + 1, &self->arg);
  for (int i = 0; i < self->tree.root[0].nkids; i++) {
    HPIPM(_sol_get_pi)(i, &self->sol, self->scratch);
    memcpy(multipliers + self->shape.nx * i, self->scratch, self->shape.nx * sizeof *multipliers);
  }
}
