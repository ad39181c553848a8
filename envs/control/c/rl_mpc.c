/* One step of the controller: filter, first guesses, iterations, fallback. rl_mpc.h is its interface, README.md says what it does.

   It follows ScenarioMPC, Controller and KalmanFilter of the Python code line by line. Compile it without -ffast-math, whatever flags
   rl_mpc_functions.c has: here is asked whether their results are finite. */

#include "rl_mpc.h"

#include <stdint.h>
#include <string.h>

#include "rl_mpc_data.h"
#include "rl_mpc_functions.h"
#include "tree_qp.h"

#if defined __FAST_MATH__ || (defined __FINITE_MATH_ONLY__ && __FINITE_MATH_ONLY__)
#error "compile rl_mpc.c without -ffast-math: it asks whether numbers are finite"
#endif

enum { NX = RL_MPC_NX, NU = RL_MPC_NU, NY = RL_MPC_NY, NGOAL = RL_MPC_NGOAL, NPSI = RL_MPC_NPSI, ROWS = RL_MPC_ROWS };
enum { HORIZON = RL_MPC_HORIZON, SCENARIOS = RL_MPC_SCENARIOS, EDGES = RL_MPC_NODES - 1, PLAN = RL_MPC_INNER * NU };

#define SOME(n) ((n) ? (n) : 1) /* C has no arrays of length 0 */

typedef struct { /* what a step needs, and nobody afterwards */
  tree_qp *qp;
  real price[SOME(EDGES * 2 * ROWS)], change[PLAN], barrier; /* of the quadratic program: times the weight of a node */
  real low[SOME(EDGES * ROWS)], high[SOME(EDGES * ROWS)], priced[SOME(EDGES * 2 * ROWS)];
  real x[NX], start[SCENARIOS * NX], psi[SOME(SCENARIOS * NPSI)], goals[HORIZON * NGOAL]; /* the problem */
  real disturbance[NX], mismatch[NX], u_before[NU];
  real guess[PLAN], plan[PLAN], step[PLAN], u_low[PLAN], u_high[PLAN], moved[PLAN];
  real cost, states[EDGES * NX], A[EDGES * NX * NX], B[EDGES * NX * NU], slope[EDGES * NX], hessian[EDGES * NX * NX];
#if RL_MPC_NZ
  real z[RL_MPC_NZ], P[RL_MPC_NZ * RL_MPC_NZ], changed[RL_MPC_NZ * RL_MPC_NZ], far[NY];
  real axes[RL_MPC_NKNOWN * RL_MPC_NKNOWN];
#endif
  const real *arg[RL_MPC_SZ_ARG]; /* of the generated functions */
  real *res[RL_MPC_SZ_RES], w[SOME(RL_MPC_SZ_W)];
  casadi_int iw[SOME(RL_MPC_SZ_IW)];
} work_memory;

static const tree_qp_shape shape = {RL_MPC_NODES, RL_MPC_INNER, NX,      NU,       ROWS,
                                    RL_MPC_CHANGES, parent,     stage,   row,      RL_MPC_QP_TOLERANCE,
                                    RL_MPC_QP_ITERATIONS};

enum { ALIGNMENT = 64, WORK = (sizeof(work_memory) + ALIGNMENT - 1) / ALIGNMENT * ALIGNMENT };

static real clip(real a, real low, real high) { return a < low ? low : a > high ? high : a; }

static int all_finite(const real *a, int n) {
  for (int i = 0; i < n; i++)
    if (!isfinite(a[i])) return 0;
  return 1;
}

size_t rl_mpc_size(void) { return ALIGNMENT + WORK + tree_qp_size(&shape); }

int rl_mpc_init(rl_mpc_state *self, void *memory, size_t size) {
  if (!self || !memory) return RL_MPC_NOT_READY;
  if (size < rl_mpc_size()) return RL_MPC_MEMORY_TOO_SMALL;
  memset(self, 0, sizeof *self);
  work_memory *work = (work_memory *)(((uintptr_t)memory + ALIGNMENT - 1) / ALIGNMENT * ALIGNMENT);
  memset(work, 0, sizeof *work);
  work->qp = tree_qp_init((char *)work + WORK, &shape);
  work->barrier = 1;
  for (int e = 0; e < EDGES; e++)
    for (int k = 0; k < 2 * ROWS; k++) {
      work->price[2 * ROWS * e + k] = weight[e + 1] * slack_price[k];
      work->barrier = fmax(work->barrier, work->price[2 * ROWS * e + k]);
    }
  for (int i = 0; i < RL_MPC_INNER; i++)
    for (int k = 0; k < NU; k++) work->change[NU * i + k] = weight[i] * change_weight[k];
  self->work = work;
  self->iterations = RL_MPC_ITERATIONS;
  self->deadline_ms = RL_MPC_DEADLINE_MS;
  return rl_mpc_reset(self, NULL);
}

int rl_mpc_reset(rl_mpc_state *self, const real *u) {
  if (!self || !self->work) return RL_MPC_NOT_READY;
  if (u && !all_finite(u, NU)) return RL_MPC_NOT_FINITE;
  self->begun = self->planned = 0;
  memset(self->x, 0, sizeof self->x);
  for (int k = 0; k < NU; k++) self->u[k] = u ? u[k] : 0;
#if RL_MPC_NZ
  self->known = 0;
  memset(self->z, 0, sizeof self->z);
  memset(self->P, 0, sizeof self->P);
  for (int i = 0; i < NY; i++) self->last[i] = NAN, self->wrong_for[i] = 0;
#endif
  return RL_MPC_OK;
}

/* State and plant from a measurement */

#if RL_MPC_NZ
enum { NZ = RL_MPC_NZ, NKNOWN = RL_MPC_NKNOWN };

/* the middle of the boxes, and what is measured as it is */
static void begin(rl_mpc_state *self, const real *y, const real *present) {
  memset(self->z, 0, sizeof self->z);
  memset(self->P, 0, sizeof self->P);
  for (int i = 0; i < NZ; i++) self->P[NZ * i + i] = prior[i];
  for (int i = 0; i < NY; i++)
    if (present[i]) self->z[measured[i]] = y[i], self->P[(NZ + 1) * measured[i]] = variance[i];
  self->known = 1;
}

/* takes an action and the measurement after it; wrong: which entries of that are */
static void predict_and_correct(rl_mpc_state *self, work_memory *work, const real *y, const real *present, int *wrong) {
  real u[NU], before[NY];
  for (int k = 0; k < NU; k++) u[k] = (self->u[k] - u_center[k]) / u_scale[k];
  for (int i = 0; i < NY; i++) before[i] = self->wrong_for[i] >= RL_MPC_PATIENCE - 1;
  work->arg[0] = self->z, work->arg[1] = self->P, work->arg[2] = u;
  work->res[0] = work->z, work->res[1] = work->P, work->res[2] = work->changed;
  rl_mpc_predict(work->arg, work->res, work->iw, work->w, 0);
  work->arg[0] = work->z, work->arg[1] = work->P, work->arg[2] = work->changed;
  work->arg[3] = y, work->arg[4] = present, work->arg[5] = before;
  work->res[0] = self->z, work->res[1] = self->P, work->res[2] = work->far;
  rl_mpc_correct(work->arg, work->res, work->iw, work->w, 0);
  for (int i = NX; i < NKNOWN; i++) self->z[i] = clip(self->z[i], -RL_MPC_FURTHEST, RL_MPC_FURTHEST);
  for (int i = 0; i < NY; i++) wrong[i] = wrong[i] || !(work->far[i] < RL_MPC_GATE);
}

static void estimate(rl_mpc_state *self, work_memory *work, const real *measurement, rl_mpc_info *info) {
  real y[NY], present[NY];
  int wrong[NY], any = 0, least = RL_MPC_LONGEST, most = 0;
  for (int i = 0; i < NY; i++) {
    const real value = measurement[i];
    present[i] = isfinite(value) && obs_low[measured[i]] <= value && value <= obs_high[measured[i]] && value != self->last[i];
    self->last[i] = value;
    y[i] = clip(((present[i] ? value : 0) - x_center[measured[i]]) / x_scale[measured[i]], -(real)1e12, (real)1e12);
    wrong[i] = !present[i];
  }
  info->restarted = 0;
  if (self->known) {
    predict_and_correct(self, work, y, present, wrong);
    for (int i = 0; i < NY; i++)
      if (present[i]) {
        self->wrong_for[i] = wrong[i] ? self->wrong_for[i] + 1 : 0;
        any = 1;
        if (self->wrong_for[i] < least) least = self->wrong_for[i];
        if (self->wrong_for[i] > most) most = self->wrong_for[i];
      }
    info->restarted = (any && (least >= RL_MPC_PATIENCE || most >= RL_MPC_LONGEST)) || !all_finite(self->z, NZ);
  }
  if (!self->known || info->restarted) {
    begin(self, y, present);
    for (int i = 0; i < NY; i++) wrong[i] = !present[i], self->wrong_for[i] = 0;
  }
  info->rejected = 0;
  for (int i = 0; i < NY; i++) info->rejected |= (unsigned)wrong[i] << (i < 31 ? i : 31);
  for (int i = 0; i < NX; i++) work->x[i] = self->z[i] * x_scale[i] + x_center[i];
}

/* where every scenario starts, and with which parameters */
static void belief(rl_mpc_state *self, work_memory *work) {
  for (int i = 0; i < NY; i++) work->disturbance[measured[i]] = self->z[NKNOWN + i] * x_scale[measured[i]];
  memcpy(work->psi, scenarios, sizeof scenarios);
#if RL_MPC_POINTS
  work->arg[0] = self->P, work->res[0] = work->axes;
  rl_mpc_axes(work->arg, work->res, work->iw, work->w, 0);
  const int most = (SCENARIOS - 1) / 2, pairs = most < NKNOWN ? most : NKNOWN, middle = SCENARIOS - 2 * pairs;
  const real longer = sqrt(SCENARIOS / 2.0);
  for (int s = 0; s < SCENARIOS; s++) {
    real z[NKNOWN], *psi = work->psi + NPSI * s;
    memcpy(z, self->z, sizeof z);
    if (s >= middle) { /* first on one side of the axes, then on the other */
      const int pair = (s - middle) % pairs;
      const real sign = s < middle + pairs ? 1 : -1;
      for (int i = 0; i < NKNOWN; i++) z[i] += sign * (work->axes[NKNOWN * pair + i] * longer);
    }
    for (int i = 0; i < NX; i++) {
      const real x = clip(z[i] * x_scale[i] + x_center[i], obs_low[i], obs_high[i]);
      work->start[NX * s + i] = (x - x_center[i]) / x_scale[i];
    }
    memcpy(psi, psi_nominal, sizeof psi_nominal);
    for (int i = NX; i < NKNOWN; i++)
      psi[uncertain[i - NX]] += clip(z[i], -RL_MPC_FURTHEST, RL_MPC_FURTHEST) * psi_half[i - NX];
  }
#else
  for (int s = 0; s < SCENARIOS; s++) {
    for (int i = 0; i < NX; i++) work->start[NX * s + i] = (work->x[i] - x_center[i]) / x_scale[i];
    for (int i = NX; i < NKNOWN; i++) work->psi[NPSI * s + uncertain[i - NX]] += self->z[i] * psi_half[i - NX];
  }
#endif
}

#else /* the state is measured */

static void estimate(rl_mpc_state *self, work_memory *work, const real *measurement, rl_mpc_info *info) {
  (void)self;
  memcpy(work->x, measurement, sizeof work->x);
  info->rejected = 0, info->restarted = 0;
}

static void belief(rl_mpc_state *self, work_memory *work) {
  (void)self;
  for (int s = 0; s < SCENARIOS; s++)
    for (int i = 0; i < NX; i++) work->start[NX * s + i] = (work->x[i] - x_center[i]) / x_scale[i];
  memcpy(work->psi, scenarios, sizeof scenarios);
}
#endif

/* Planning */

static void give_problem(work_memory *work, const real *plan) {
  const real *given[] = {work->start,    work->psi,   weight,        work->goals,    work->disturbance,
                           work->mismatch, slack_price, change_weight, work->u_before, plan};
  memcpy(work->arg, given, sizeof given);
}

/* not a number if a state of the plan is not finite */
static real cost_of(work_memory *work, const real *plan) {
  give_problem(work, plan);
  work->res[0] = &work->cost, work->res[1] = work->states;
  rl_mpc_rollout(work->arg, work->res, work->iw, work->w, 0);
  return all_finite(work->states, EDGES * NX) ? work->cost : NAN;
}

/* keeps work->guess as the plan if it is the cheapest so far */
static void compare(work_memory *work, int guess, rl_mpc_info *info) {
  const real cost = cost_of(work, work->guess);
  if (isfinite(cost) && (info->guess == RL_MPC_NONE || cost < info->cost)) {
    info->guess = guess, info->cost = cost;
    memcpy(work->plan, work->guess, sizeof work->plan);
  }
}

static void first_guesses(rl_mpc_state *self, work_memory *work, rl_mpc_info *info) {
  info->guess = RL_MPC_NONE;
  if (self->planned) {
    real distance = 0;
    for (int i = 0; i < RL_MPC_INNER; i++) memcpy(work->guess + NU * i, self->plan + NU * later[i], NU * sizeof(real));
    compare(work, RL_MPC_SHIFTED, info);
    for (int i = 0; i < NX; i++) distance = fmax(distance, fabs((work->x[i] - self->x[i]) / x_scale[i]));
    if (distance < (real)RL_MPC_HARDLY_MOVED) { /* where things move, an action that is planned for later would be put off for ever */
      memcpy(work->guess, self->plan, sizeof work->guess);
      compare(work, RL_MPC_LAST, info);
    }
  }
#if RL_MPC_POLICY
  give_problem(work, NULL);
  work->res[0] = work->guess;
  rl_mpc_follow(work->arg, work->res, work->iw, work->w, 0);
  compare(work, RL_MPC_FOLLOWED, info);
#else
  memset(work->guess, 0, sizeof work->guess);
  compare(work, RL_MPC_MIDDLE, info);
#endif
}

/* the step to the minimum of the quadratic program about work->plan, and by how much it lowers the cost; 0 if it is not found */
static int quadratic_program(work_memory *work, real *predicted) {
  real slack_below = 0, slack_above = 0, found;
  int counted;
  give_problem(work, work->plan);
  work->res[0] = work->states, work->res[1] = work->A, work->res[2] = work->B, work->res[3] = work->slope, work->res[4] = work->hessian;
  rl_mpc_linearise(work->arg, work->res, work->iw, work->w, 0);
  for (int e = 0; e < EDGES; e++) {
    for (int k = 0; k < NX; k++) work->slope[NX * e + k] *= weight[e + 1];
    for (int k = 0; k < NX * NX; k++) work->hessian[NX * NX * e + k] *= weight[e + 1];
    for (int j = 0; j < ROWS; j++) {
      const int at = ROWS * e + j, below = 2 * ROWS * e + j, above = below + ROWS;
      const real x = work->states[NX * e + row[j]], low = x_low[j] - x, high = x_high[j] - x;
      slack_below += work->price[below] * fmax(low, 0);
      slack_above += work->price[above] * fmax(-high, 0);
      /* where there is no bound one out of reach, at the other's price */
      work->low[at] = bounded_below[j] ? low : fmin(high, 0) - (real)RL_MPC_OUT_OF_REACH;
      work->high[at] = bounded_above[j] ? high : fmax(low, 0) + (real)RL_MPC_OUT_OF_REACH;
      work->priced[below] = work->price[bounded_below[j] ? below : above];
      work->priced[above] = work->price[bounded_above[j] ? above : below];
    }
  }
  for (int i = 0; i < RL_MPC_INNER; i++)
    for (int k = 0; k < NU; k++) {
      const int at = NU * i + k;
      work->u_low[at] = -1 - work->plan[at], work->u_high[at] = 1 - work->plan[at];
      work->moved[at] = work->plan[at] - (i ? work->plan[NU * parent[i] + k] : work->u_before[k]);
    }
  const int failed = tree_qp_solve(work->qp, work->A, work->B, work->slope, work->hessian, work->u_low, work->u_high, work->low,
                                   work->high, work->priced, work->change, work->moved, work->barrier, work->step, &found, &counted);
  if (failed || !all_finite(work->step, PLAN)) return 0;
  *predicted = slack_below + slack_above - found;
  return 1;
}

/* work->plan after as many iterations as it may have */
static void improve(rl_mpc_state *self, work_memory *work, double began, rl_mpc_info *info) {
  info->stop = RL_MPC_LIMIT;
  for (int i = 0; i < self->iterations; i++) {
    if (self->now_ms && self->now_ms() - began > self->deadline_ms) {
      info->stop = RL_MPC_LATE;
      return;
    }
    info->iterations++;
    real predicted;
    if (!quadratic_program(work, &predicted)) {
      info->stop = RL_MPC_UNSOLVED;
      return;
    }
    info->predicted = predicted;
    const real tolerance = (real)RL_MPC_TOLERANCE * fabs(info->cost), before = info->cost;
    real share = 1;
    for (int halvings = 0; halvings < (predicted > tolerance ? RL_MPC_SHARES : 1); halvings++, share /= 2) {
      for (int k = 0; k < PLAN; k++) work->guess[k] = clip(work->plan[k] + share * work->step[k], -1, 1);
      const real cost = cost_of(work, work->guess);
      if (cost < before && !(before - cost < (real)0.1 * share * predicted)) {
        memcpy(work->plan, work->guess, sizeof work->plan);
        info->cost = cost;
        break;
      }
    }
    const int as_predicted = fabs(before - info->cost - predicted) <= tolerance;
    if (as_predicted || info->cost == before) {
      info->stop = as_predicted ? RL_MPC_STATIONARY : RL_MPC_STALLED;
      return;
    }
  }
}

/* the action of the plan, else of the policy, else not a number */
static void act(rl_mpc_state *self, work_memory *work, const real *goal, double began, real *u, rl_mpc_info *info) {
  belief(self, work);
  for (int t = 0; t < HORIZON; t++) memcpy(work->goals + NGOAL * t, goal, sizeof(real) * NGOAL);
  for (int k = 0; k < NU; k++) work->u_before[k] = (self->u[k] - u_center[k]) / u_scale[k];
  first_guesses(self, work, info);
  self->planned = info->guess != RL_MPC_NONE;
  if (self->planned) {
    info->rung = RL_MPC_PLAN, info->guess_cost = info->cost;
    improve(self, work, began, info);
    memcpy(self->plan, work->plan, sizeof self->plan);
    for (int k = 0; k < NU; k++) u[k] = self->plan[k] * u_scale[k] + u_center[k];
    return;
  }
  info->rung = RL_MPC_ACTOR;
#if RL_MPC_POLICY
  work->arg[0] = work->x, work->arg[1] = goal, work->arg[2] = work->mismatch, work->res[0] = u;
  rl_mpc_mu(work->arg, work->res, work->iw, work->w, 0);
#else
  for (int k = 0; k < NU; k++) u[k] = NAN;
#endif
}

int rl_mpc_step(rl_mpc_state *self, const real *y, const real *goal, real *u, rl_mpc_info *info) {
  rl_mpc_info unwanted;
  if (!self || !self->work || !y || !goal || !u) return RL_MPC_NOT_READY;
  work_memory *work = self->work;
  const double began = self->now_ms ? self->now_ms() : 0;
  int code = RL_MPC_OK;
  real near[NY], action[NU], applied[NU];
  info = info ? info : &unwanted;
  memset(info, 0, sizeof *info);
  info->rung = RL_MPC_HOLD;
  for (int k = 0; k < NU; k++) applied[k] = clip(self->u[k], u_low[k], u_high[k]);
#if !RL_MPC_NZ
  if (!all_finite(y, NY)) code = RL_MPC_NOT_FINITE;
#endif
  for (int i = 0; i < NGOAL; i++)
    if (!(goal_low[i] <= goal[i] && goal[i] <= goal_high[i])) code = RL_MPC_BAD_GOAL;
  if (code == RL_MPC_OK) {
    const real turn = (real)6.283185307179586;
    for (int i = 0; i < NY; i++) { /* angles to the turn nearest to the last */
      near[i] = turns[i] && isfinite(y[i]) ? fmod(y[i], turn) : y[i];
      if (turns[i] && self->begun) near[i] += turn * rint((self->x[measured[i]] - near[i]) / turn);
    }
    estimate(self, work, near, info);
    act(self, work, goal, began, action, info);
    if (all_finite(action, NU))
      for (int k = 0; k < NU; k++) applied[k] = clip(action[k], u_low[k], u_high[k]);
    else
      info->rung = RL_MPC_HOLD;
    memcpy(self->x, work->x, sizeof self->x);
    memcpy(self->u, applied, sizeof self->u);
    self->begun = 1;
  }
  memcpy(u, applied, sizeof applied);
  return code;
}
