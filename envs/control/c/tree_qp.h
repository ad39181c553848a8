/* The quadratic program of a scenario tree; tree_qp.c says which. Matrices are stored column by column, everything else node by node.
   No globals; all memory is the caller's. Compile it without -ffast-math: not-a-number must stay what it is. */

#ifndef TREE_QP_H
#define TREE_QP_H

#include <stddef.h>

#include "real.h"

typedef struct tree_qp tree_qp;

/* A tree: parents come before their children, nodes with children before all others.
   parent, stage: of every node, the root's parent is -1; row: the bounded states; changes: whether a change of the actions has a price */
typedef struct {
  int nodes, inner, nx, nu, rows, changes; /* inner: nodes with children */
  const int *parent, *stage, *row;         /* they stay the caller's, and must stay */
  real tolerance;                          /* of the interior point's residuals */
  int most;                                /* iterations of it */
} tree_qp_shape;

/* Bytes that tree_qp_init takes. Takes a hundred and fifty bytes per node of the stack. */
size_t tree_qp_size(const tree_qp_shape *shape);

/* A solver in the memory given, at any address. */
tree_qp *tree_qp_init(void *memory, const tree_qp_shape *shape);

/* 0 if solved, HPIPM's status otherwise. Bounds are relative to the present plan; x_low, x_high: of the bounded states, price: (2, rows)
   per node, below and above; barrier: where the interior point starts, about the largest price. Finds du, the cost there, and how many
   iterations it took. */
int tree_qp_solve(tree_qp *self, const real *A, const real *B, const real *q, const real *H, const real *u_low,
                  const real *u_high, const real *x_low, const real *x_high, const real *price, const real *c,
                  const real *moved, real barrier, real *du, real *cost, int *iterations);

/* Solves the last problem once more and finds how its cost changes with the states dx of stage 1, (their number, nx), if all that comes
   after them is adapted. */
void tree_qp_multipliers(tree_qp *self, real *multipliers);

/* Projection of the symmetric part of h, (n, n), to positive semidefinite matrices; work: 2 n^2 numbers */
void tree_qp_positive_part(int n, const real *h, real *result, real *work);

#endif
