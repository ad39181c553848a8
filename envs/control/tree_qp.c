/* The quadratic program of a scenario tree, solved by HPIPM (Frison and Diehl, IFAC-PapersOnLine 53(2), 2020) by a Riccati recursion
   over the tree:

       minimise over du, dx   sum over nodes i > 0        q_i'dx_i + dx_i' (H_i)+ dx_i / 2 + price_i' (violation of the state bounds)
                            + sum over nodes with children  c_i' (moved_i + du_i - du_parent(i))^2 - c_i' moved_i^2
       subject to             dx_i = A_i dx_parent(i) + B_i du_parent(i),   dx_0 = 0, du_parent(0) = 0,   u_low_i <= du_i <= u_high_i

   (H)+ is the projection of a symmetric matrix to positive semidefinite ones. Nodes are numbered so that parents come first and those
   with children before all others. Matrices are stored column by column, everything else node by node. No globals; tree_qp_new
   allocates, tree_qp_solve does not. Compile it without -ffast-math: not-a-number must stay what it is. */

#include <math.h>
#include <stdlib.h>
#include <string.h>

#include <hpipm_d_tree_ocp_qp.h>
#include <hpipm_d_tree_ocp_qp_dim.h>
#include <hpipm_d_tree_ocp_qp_ipm.h>
#include <hpipm_d_tree_ocp_qp_sol.h>
#include <hpipm_tree.h>

#define RIDGE 1e-8 /* on du, so that an action that no cost depends on has a solution */

typedef struct {
  int nodes, inner, nx, nu, rows, changes; /* inner: with children; rows: bounded states; changes: whether c is not zero */
  struct tree tree;
  struct d_tree_ocp_qp_dim dim;
  struct d_tree_ocp_qp qp;
  struct d_tree_ocp_qp_sol sol;
  struct d_tree_ocp_qp_ipm_arg arg;
  struct d_tree_ocp_qp_ipm_ws ws;
  int *row;
  double *scratch, *positive, *dx; /* (H)+ and dx of every edge */
  void *memory[16];
  int used;
} tree_qp;

static void *take(tree_qp *self, size_t bytes) {
  return self->memory[self->used++] = calloc(1, bytes + 64);
}

void tree_qp_free(tree_qp *self) {
  for (int i = 0; i < self->used; i++) free(self->memory[i]);
  free(self);
}

/* size of a node's state: of nodes with children the action before belongs to it, if its change has a price */
static int size(const tree_qp *self, int node) {
  return node == 0 ? 0 : self->nx + (self->changes && node < self->inner ? self->nu : 0);
}

/* parent, stage: of every node, the root's parent is -1; row: the bounded states */
tree_qp *tree_qp_new(int nodes, int inner, int nx, int nu, int rows, int changes, const int *parent, const int *stage, const int *row,
                     double tolerance, int most) {
  tree_qp *self = calloc(1, sizeof *self);
  self->nodes = nodes, self->inner = inner, self->nx = nx, self->nu = nu, self->rows = rows, self->changes = changes;
  struct node *node = take(self, nodes * sizeof *node);
  int *kids = take(self, nodes * sizeof *kids), *number = take(self, 6 * nodes * sizeof *number), at = 0;
  for (int i = 0; i < nodes; i++) {
    node[i].idx = i, node[i].dad = parent[i], node[i].stage = stage[i], node[i].kids = kids + at;
    for (int k = i + 1; k < nodes; k++)
      if (parent[k] == i) node[k].idxkid = node[i].nkids++, kids[at++] = k;
    const int of[6] = {size(self, i), i < inner ? nu : 0, i ? rows : 0, i < inner ? nu : 0, 0, i ? rows : 0};
    for (int k = 0; k < 6; k++) number[k * nodes + i] = of[k]; /* states, actions, bounds on each, general ones, slacks */
  }
  self->tree.root = node, self->tree.kids = kids, self->tree.Nn = nodes;
  d_tree_ocp_qp_dim_create(nodes, &self->dim, take(self, d_tree_ocp_qp_dim_memsize(nodes)));
  d_tree_ocp_qp_dim_set_all(&self->tree, number, number + nodes, number + 2 * nodes, number + 3 * nodes, number + 4 * nodes,
                            number + 5 * nodes, &self->dim);
  d_tree_ocp_qp_create(&self->dim, &self->qp, take(self, d_tree_ocp_qp_memsize(&self->dim)));
  d_tree_ocp_qp_sol_create(&self->dim, &self->sol, take(self, d_tree_ocp_qp_sol_memsize(&self->dim)));
  d_tree_ocp_qp_ipm_arg_create(&self->dim, &self->arg, take(self, d_tree_ocp_qp_ipm_arg_memsize(&self->dim)));
  d_tree_ocp_qp_ipm_arg_set_default(SPEED_ABS, &self->arg);
  d_tree_ocp_qp_ipm_arg_set_iter_max(&most, &self->arg);
  d_tree_ocp_qp_ipm_arg_set_tol_stat(&tolerance, &self->arg);
  d_tree_ocp_qp_ipm_arg_set_tol_eq(&tolerance, &self->arg);
  d_tree_ocp_qp_ipm_arg_set_tol_ineq(&tolerance, &self->arg);
  d_tree_ocp_qp_ipm_arg_set_tol_comp(&tolerance, &self->arg);
  d_tree_ocp_qp_ipm_ws_create(&self->dim, &self->arg, &self->ws, take(self, d_tree_ocp_qp_ipm_ws_memsize(&self->dim, &self->arg)));
  /* what never changes: which variables have bounds and slacks, and that slack has no quadratic price */
  const int wide = nx + nu;
  self->scratch = take(self, (4 * wide * wide + 8 * wide) * sizeof(double));
  self->positive = take(self, nodes * nx * nx * sizeof(double));
  self->dx = take(self, nodes * nx * sizeof(double));
  self->row = memcpy(take(self, rows * sizeof *row), row, rows * sizeof *row);
  int *index = take(self, wide * sizeof *index), *soft = take(self, (rows + 1) * sizeof *soft);
  for (int i = 0; i < wide; i++) index[i] = i;
  for (int i = 0; i < nodes; i++) {
    if (i < inner) {
      d_tree_ocp_qp_set_idxbu(i, index, &self->qp);
      if (i) d_tree_ocp_qp_set_S(i, self->scratch, &self->qp);
    }
    if (i) {
      for (int j = 0; j < rows; j++) soft[j] = (i < inner ? nu : 0) + j;
      d_tree_ocp_qp_set_b(i - 1, self->scratch, &self->qp);
      d_tree_ocp_qp_set_idxbx(i, (int *)row, &self->qp);
      d_tree_ocp_qp_set_idxs(i, soft, &self->qp);
      d_tree_ocp_qp_set_Zl(i, self->scratch, &self->qp);
      d_tree_ocp_qp_set_Zu(i, self->scratch, &self->qp);
      d_tree_ocp_qp_set_lls(i, self->scratch, &self->qp);
      d_tree_ocp_qp_set_lus(i, self->scratch, &self->qp);
    }
  }
  return self;
}

/* (H)+ by cyclic Jacobi rotations (Golub and Van Loan, section 8.5); work: 2 n^2 numbers */
static void positive_part(int n, const double *h, double *result, double *work) {
  double *m = work, *v = work + n * n, total = 0;
  for (int i = 0; i < n * n; i++) {
    m[i] = (h[i] + h[i % n * n + i / n]) / 2;
    v[i] = i % n == i / n;
    total += m[i] * m[i];
  }
  for (int sweep = 0; sweep < 30; sweep++) {
    double off = 0;
    for (int q = 1; q < n; q++)
      for (int p = 0; p < q; p++) off += m[q * n + p] * m[q * n + p];
    if (!(off > 1e-26 * total)) break;
    for (int q = 1; q < n; q++)
      for (int p = 0; p < q; p++) {
        if (m[q * n + p] == 0) continue;
        const double theta = (m[q * n + q] - m[p * n + p]) / (2 * m[q * n + p]);
        const double t = (theta >= 0 ? 1 : -1) / (fabs(theta) + sqrt(theta * theta + 1)), c = 1 / sqrt(t * t + 1), s = t * c;
        for (int k = 0; k < n; k++) { /* columns p and q of m and v */
          const double a = m[p * n + k], b = m[q * n + k], d = v[p * n + k], e = v[q * n + k];
          m[p * n + k] = c * a - s * b, m[q * n + k] = s * a + c * b;
          v[p * n + k] = c * d - s * e, v[q * n + k] = s * d + c * e;
        }
        for (int k = 0; k < n; k++) { /* rows p and q of m */
          const double a = m[k * n + p], b = m[k * n + q];
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

void tree_qp_positive_part(int n, const double *h, double *result) {
  double *work = malloc(2 * n * n * sizeof *work);
  positive_part(n, h, result, work);
  free(work);
}

/* a, (rows, columns), in the upper left corner of zeros; a itself where nothing is added */
static double *widened(const double *a, int rows, int columns, int all_rows, int all_columns, double *scratch) {
  if (rows == all_rows && columns == all_columns) return (double *)a;
  memset(scratch, 0, all_rows * all_columns * sizeof *scratch);
  for (int j = 0; j < columns; j++) memcpy(scratch + j * all_rows, a + j * rows, rows * sizeof *scratch);
  return scratch;
}

/* what is minimised, at du */
static double cost_at(tree_qp *self, const double *du, const double *A, const double *B, const double *q, const double *x_low,
                      const double *x_high, const double *price, const double *c, const double *moved) {
  const int nx = self->nx, nu = self->nu, rows = self->rows;
  double cost = 0;
  for (int i = 0; i < self->inner; i++)
    for (int k = 0; k < nu; k++) {
      const double step = du[nu * i + k] - (i ? du[nu * self->tree.root[i].dad + k] : 0);
      cost += c[nu * i + k] * (step + 2 * moved[nu * i + k]) * step;
    }
  for (int i = 1; i < self->nodes; i++) {
    const int e = i - 1, dad = self->tree.root[i].dad;
    const double *H = self->positive + nx * nx * e, *before = dad ? self->dx + nx * (dad - 1) : NULL;
    double *x = self->dx + nx * e;
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
      const double at = x[self->row[j]], *p = price + 2 * rows * e;
      cost += p[j] * fmax(x_low[rows * e + j] - at, 0) + p[rows + j] * fmax(at - x_high[rows * e + j], 0);
    }
  }
  return cost;
}

/* 0 if solved, HPIPM's status otherwise. Bounds relative to the present plan; x_low, x_high: of the bounded states, price: (2, rows) per
   node, below and above; barrier: where the interior point starts, about the largest price */
int tree_qp_solve(tree_qp *self, const double *A, const double *B, const double *q, const double *H, const double *u_low,
                  const double *u_high, const double *x_low, const double *x_high, const double *price, const double *c,
                  const double *moved, double barrier, double *du, double *cost, int *iterations) {
  const int nx = self->nx, nu = self->nu, rows = self->rows, wide = nx + nu;
  double *s = self->scratch, *work = s + wide * wide;
  struct d_tree_ocp_qp *qp = &self->qp;
  int status;
  for (int i = 0; i < self->nodes; i++) {
    if (i < self->inner) {
      d_tree_ocp_qp_set_lbu(i, (double *)u_low + nu * i, qp);
      d_tree_ocp_qp_set_ubu(i, (double *)u_high + nu * i, qp);
      memset(s, 0, nu * (nu + 1) * sizeof *s);
      for (int k = 0; k < nu; k++) s[k * nu + k] = RIDGE + 2 * c[nu * i + k], s[nu * nu + k] = 2 * c[nu * i + k] * moved[nu * i + k];
      d_tree_ocp_qp_set_R(i, s, qp);
      d_tree_ocp_qp_set_r(i, s + nu * nu, qp);
      if (i && self->changes) {
        memset(s, 0, nu * wide * sizeof *s);
        for (int k = 0; k < nu; k++) s[(nx + k) * nu + k] = -2 * c[nu * i + k];
        d_tree_ocp_qp_set_S(i, s, qp);
      }
    }
    if (i == 0) continue;
    const int e = i - 1, here = size(self, i), before = size(self, self->tree.root[i].dad);
    if (before) d_tree_ocp_qp_set_A(e, widened(A + nx * nx * e, nx, nx, here, before, s), qp);
    double *b = widened(B + nx * nu * e, nx, nu, here, nu, s);
    for (int k = 0; k < here - nx; k++) b[k * here + nx + k] = 1; /* the action is the next node's action before */
    d_tree_ocp_qp_set_B(e, b, qp);
    double *positive = self->positive + nx * nx * e;
    positive_part(nx, H + nx * nx * e, positive, work);
    double *Q = widened(positive, nx, nx, here, here, s);
    for (int k = 0; k < here - nx; k++) Q[(nx + k) * here + nx + k] = 2 * c[nu * i + k];
    d_tree_ocp_qp_set_Q(i, Q, qp);
    double *slope = widened(q + nx * e, nx, 1, here, 1, s);
    for (int k = 0; k < here - nx; k++) slope[nx + k] = -2 * c[nu * i + k] * moved[nu * i + k];
    d_tree_ocp_qp_set_q(i, slope, qp);
    d_tree_ocp_qp_set_lbx(i, (double *)x_low + rows * e, qp);
    d_tree_ocp_qp_set_ubx(i, (double *)x_high + rows * e, qp);
    d_tree_ocp_qp_set_zl(i, (double *)price + 2 * rows * e, qp);
    d_tree_ocp_qp_set_zu(i, (double *)price + 2 * rows * e + rows, qp);
  }
  d_tree_ocp_qp_ipm_arg_set_mu0(&barrier, &self->arg);
  d_tree_ocp_qp_ipm_solve(qp, &self->sol, &self->arg, &self->ws);
  d_tree_ocp_qp_ipm_get_iter(&self->ws, iterations);
  d_tree_ocp_qp_ipm_get_status(&self->ws, &status);
  for (int i = 0; i < self->inner; i++) {
    d_tree_ocp_qp_sol_get_u(i, &self->sol, du + nu * i);
    for (int k = nu * i; k < nu * (i + 1); k++) du[k] = du[k] < u_low[k] ? u_low[k] : du[k] > u_high[k] ? u_high[k] : du[k];
  }
  *cost = cost_at(self, du, A, B, q, x_low, x_high, price, c, moved);
  return status;
}
