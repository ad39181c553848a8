/* Recorded steps of the Python controller again: the state before each, measurement and goal, its action and the cost of its plan. Exit
   code 0 if 99 % of the actions are within a millionth of their range; another compiler or processor rounds otherwise, which can tip a
   choice between equals. In single precision flat directions are decided by rounding: there 95 % of the costs must be within a percent. */

#include <math.h>
#include <stdio.h>
#include <stdlib.h>

#include "check_data.h"
#include "rl_mpc.h"

static const double *record = records;

/* the next n numbers of the records */
static void next(rl_mpc_real *values, int n) {
  while (n--) *values++ = (rl_mpc_real)*record++;
}

static int whole(void) { return (int)*record++; }

static void restore(rl_mpc_state *state) {
  state->begun = whole(), state->planned = whole();
  next(state->x, RL_MPC_NX);
  next(state->u, RL_MPC_NU);
  next(state->plan, RL_MPC_INNER * RL_MPC_NU);
#if RL_MPC_NZ
  state->known = whole();
  next(state->z, RL_MPC_NZ);
  next(state->P, RL_MPC_NZ * RL_MPC_NZ);
  next(state->last, RL_MPC_NY);
  for (int i = 0; i < RL_MPC_NY; i++) state->wrong_for[i] = whole();
#endif
}

int main(void) {
  static const double low[] = RL_MPC_U_LOW, high[] = RL_MPC_U_HIGH;
  rl_mpc_real y[RL_MPC_NY], goal[RL_MPC_NGOAL], u[RL_MPC_NU];
  double largest = 0;
  int close = 0, as_cheap = 0;
  rl_mpc_state state;
  rl_mpc_info info;
  void *memory = malloc(rl_mpc_size());
  if (rl_mpc_init(&state, memory, rl_mpc_size()) != RL_MPC_OK) return 1;
  for (int i = 0; i < RECORDS; i++) {
    restore(&state);
    next(y, RL_MPC_NY);
    next(goal, RL_MPC_NGOAL);
    if (rl_mpc_step(&state, y, goal, u, &info) != RL_MPC_OK) return 1;
    double difference = 0;
    for (int k = 0; k < RL_MPC_NU; k++) difference = fmax(difference, fabs(u[k] - *record++) / (high[k] - low[k]));
    close += difference <= 1e-6;
    largest = fmax(largest, difference);
    const double cost = *record++;
    as_cheap += isnan(cost) ? info.rung != RL_MPC_PLAN : fabs(info.cost - cost) <= 0.01 * fabs(cost);
  }
  printf("%d of %d actions within 1e-6 of their range, the largest difference %.1e; %d costs within 1 %%; memory %lu bytes\n", close,
         RECORDS, largest, as_cheap, (unsigned long)rl_mpc_size());
  free(memory);
  return (sizeof(rl_mpc_real) > 4 ? close >= 0.99 * RECORDS : as_cheap >= 0.95 * RECORDS) ? 0 : 1;
}
