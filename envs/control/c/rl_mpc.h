/* $title

   A controller in C99: rl_mpc_init once, then rl_mpc_step at every sampling time ($dt). All memory is the caller's, nothing is
   allocated, there are no globals, and several controllers may run side by side. All numbers are in the units below. README.md tells
   more. */

#ifndef RL_MPC_H
#define RL_MPC_H

#include <math.h>
#include <stddef.h>

#ifdef __cplusplus
extern "C" {
#endif

/* With RL_MPC_SINGLE everything is in single precision; files compiled with it and without do not link. */
#ifdef RL_MPC_SINGLE
typedef float rl_mpc_real;
#define rl_mpc_size rl_mpc_size_single
#define rl_mpc_init rl_mpc_init_single
#define rl_mpc_reset rl_mpc_reset_single
#define rl_mpc_step rl_mpc_step_single
#else
typedef double rl_mpc_real;
#endif

$sizes

$limits

/* Memory: rl_mpc_init takes rl_mpc_size() bytes, which are RL_MPC_MEMORY on the machine that wrote this. The stack needs 8 kB, and in rl_mpc_init
   another 150 bytes per node. */
#define RL_MPC_MEMORY $memory

/* What rl_mpc_init, rl_mpc_reset and rl_mpc_step return. Where that is not RL_MPC_OK the state is as it was, and rl_mpc_step gives the last
   action again (but for RL_MPC_NOT_READY, which touches nothing). */
enum {
  RL_MPC_OK,
  RL_MPC_NOT_FINITE,       /* $not_finite is not finite */
  RL_MPC_BAD_GOAL,         /* the goal is outside of RL_MPC_GOAL_LOW to RL_MPC_GOAL_HIGH, or not a number */
  RL_MPC_NOT_READY,        /* a pointer is NULL, or a state of zeros has not been through rl_mpc_init */
  RL_MPC_MEMORY_TOO_SMALL, /* less than rl_mpc_size() bytes */
};

/* What chose the action: the plan; the policy, since no first guess had a finite cost; or neither, so that the last action stays. */
enum { RL_MPC_PLAN, RL_MPC_ACTOR, RL_MPC_HOLD };

/* The first guess that was improved: none; the last plan one sampling time later; the last plan as it was, where the plant hardly
   moved; what the policy would do; every action in the middle of its limits. */
enum { RL_MPC_NONE, RL_MPC_SHIFTED, RL_MPC_LAST, RL_MPC_FOLLOWED, RL_MPC_MIDDLE };

/* Why it stopped: the plan is as good as the last quadratic program promised; as many iterations as allowed; the deadline; the
   quadratic program was not solved; no share of its step lowers the cost. */
enum { RL_MPC_STATIONARY, RL_MPC_LIMIT, RL_MPC_LATE, RL_MPC_UNSOLVED, RL_MPC_STALLED };

/* What happened in a step. */
typedef struct {
  int rung, guess, stop; /* the enumerations above; guess and what follows only where rung is RL_MPC_PLAN */
  int iterations;
  rl_mpc_real guess_cost, cost; /* of the first guess and of the plan, never more */
  rl_mpc_real predicted;        /* by how much the last quadratic program meant to lower the cost */
  unsigned rejected;       /* bit i: measurement i was missing or wrong, and left out (from 31 on together) */
  int restarted;           /* whether the filter has started again */
} rl_mpc_info;

/* What the controller remembers from step to step. To save and restore it, copy everything above `iterations`. */
typedef struct {
  int begun, planned;                  /* whether there has been a step, and whether it left a plan */
  rl_mpc_real x[RL_MPC_NX], u[RL_MPC_NU];   /* last state, measured or estimated, and last action */
  rl_mpc_real plan[RL_MPC_INNER * RL_MPC_NU]; /* actions of the nodes that have children, on a scale from -1 to 1 */
#if RL_MPC_NZ                            /* the filter */
  int known;                             /* whether it has begun */
  rl_mpc_real z[RL_MPC_NZ], P[RL_MPC_NZ * RL_MPC_NZ]; /* state, parameters, disturbances; scaled; and their covariance */
  rl_mpc_real last[RL_MPC_NY];                        /* measurement */
  int wrong_for[RL_MPC_NY];                      /* steps */
#endif
  /* settings, which may be changed before every step */
  int iterations;         /* the most in a step; rl_mpc_init: RL_MPC_ITERATIONS */
  double deadline_ms;          /* no iteration begins later than this after the step began; rl_mpc_init: RL_MPC_DEADLINE_MS */
  double (*now_ms)(void);      /* a clock for it, milliseconds from any origin; NULL: no deadline */
  void *work;             /* set by rl_mpc_init */
} rl_mpc_state;

/* How many bytes rl_mpc_init takes. */
size_t rl_mpc_size(void);

/* Prepares a state, with so many bytes of memory at any address, which belong to it from then on. */
int rl_mpc_init(rl_mpc_state *state, void *memory, size_t size);

/* Forgets everything, as at the start of an episode. u: the action that the plant gets now; NULL: 0. */
int rl_mpc_reset(rl_mpc_state *state, const rl_mpc_real *u);

/* The action u, finite and within its limits, for the measurement y; u may be where y or goal is, info may be NULL.
   $measurement */
int rl_mpc_step(rl_mpc_state *state, const rl_mpc_real *y, const rl_mpc_real *goal, rl_mpc_real *u, rl_mpc_info *info);

#ifdef __cplusplus
}
#endif

#endif
