/* Recorded steps of the Python controller again: the state before each, measurement and goal, and its action. Exit code 0 if 99 % of the
   actions are within a millionth of their range. Another compiler or processor rounds otherwise, which can tip a choice between equals. */

#include <math.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

#include "check_data.h"
#include "rl_mpc.h"

/* the next n numbers of a record */
static const double *next(const double **record, int n) {
  *record += n;
  return *record - n;
}

static void restore(rl_mpc_state *state, const double **record) {
  state->begun = (int)*next(record, 1), state->planned = (int)*next(record, 1);
  memcpy(state->x, next(record, RL_MPC_NX), sizeof state->x);
  memcpy(state->u, next(record, RL_MPC_NU), sizeof state->u);
  memcpy(state->plan, next(record, RL_MPC_INNER * RL_MPC_NU), sizeof state->plan);
#if RL_MPC_NZ
  state->known = (int)*next(record, 1);
  memcpy(state->z, next(record, RL_MPC_NZ), sizeof state->z);
  memcpy(state->P, next(record, RL_MPC_NZ * RL_MPC_NZ), sizeof state->P);
  memcpy(state->last, next(record, RL_MPC_NY), sizeof state->last);
  for (int i = 0; i < RL_MPC_NY; i++) state->wrong_for[i] = (int)*next(record, 1);
#endif
}

int main(void) {
  static const double low[] = RL_MPC_U_LOW, high[] = RL_MPC_U_HIGH;
  const double *record = records;
  double u[RL_MPC_NU], largest = 0;
  int close = 0;
  rl_mpc_state state;
  void *memory = malloc(rl_mpc_size());
  if (rl_mpc_init(&state, memory, rl_mpc_size()) != RL_MPC_OK) return 1;
  for (int i = 0; i < RECORDS; i++) {
    restore(&state, &record);
    const double *y = next(&record, RL_MPC_NY), *goal = next(&record, RL_MPC_NGOAL), *expected = next(&record, RL_MPC_NU);
    if (rl_mpc_step(&state, y, goal, u, NULL) != RL_MPC_OK) return 1;
    double difference = 0;
    for (int k = 0; k < RL_MPC_NU; k++) difference = fmax(difference, fabs(u[k] - expected[k]) / (high[k] - low[k]));
    close += difference <= 1e-6;
    largest = fmax(largest, difference);
  }
  printf("%d of %d actions within 1e-6 of their range, the largest difference %.1e; memory %lu bytes\n", close, RECORDS, largest,
         (unsigned long)rl_mpc_size());
  free(memory);
  return close >= 0.99 * RECORDS ? 0 : 1;
}
