/* The closed loop on the plant's own model, from its start, as CSV: time, states, goal, actions, which rung chose them (0: the plan),
   iterations and computing time of the step. */

#include <stdio.h>
#include <stdlib.h>
#include <time.h>

#include "plant.h"
#include "rl_mpc.h"

#define STEPS 100

static double now_ms(void) { return 1e3 * clock() / CLOCKS_PER_SEC; }

int main(void) {
  static const rl_mpc_real start[] = RL_MPC_PLANT_START, goal[] = RL_MPC_PLANT_GOAL, psi[] = RL_MPC_PLANT_PSI;
  static const int measured[] = RL_MPC_PLANT_MEASURED;
  rl_mpc_real x[RL_MPC_NX], y[RL_MPC_NY], u[RL_MPC_NU], after[RL_MPC_NX], work[1 + rl_mpc_plant_SZ_W];
  casadi_int integers[1 + rl_mpc_plant_SZ_IW];
  rl_mpc_state state;
  rl_mpc_info info;
  void *memory = malloc(rl_mpc_size());
  if (rl_mpc_init(&state, memory, rl_mpc_size()) != RL_MPC_OK) return 1;
  state.now_ms = now_ms;
  puts(RL_MPC_PLANT_COLUMNS);
  for (int i = 0; i < RL_MPC_NX; i++) x[i] = start[i];
  for (int step = 0; step < STEPS; step++) {
    for (int i = 0; i < RL_MPC_NY; i++) y[i] = x[measured[i]]; /* here your sensors */
    const double began = now_ms();
    if (rl_mpc_step(&state, y, goal, u, &info) != RL_MPC_OK) return 1;
    const double took = now_ms() - began;
    printf("%g", step * RL_MPC_DT);
    for (int i = 0; i < RL_MPC_NX; i++) printf(",%g", x[i]);
    for (int i = 0; i < RL_MPC_NGOAL; i++) printf(",%g", goal[i]);
    for (int i = 0; i < RL_MPC_NU; i++) printf(",%g", u[i]);
    printf(",%d,%d,%g\n", info.rung, info.iterations, took);
    const rl_mpc_real *arg[rl_mpc_plant_SZ_ARG] = {x, u, psi}; /* here your actuators */
    rl_mpc_real *res[rl_mpc_plant_SZ_RES] = {after};
    rl_mpc_plant(arg, res, integers, work, 0);
    for (int i = 0; i < RL_MPC_NX; i++) x[i] = after[i];
  }
  free(memory);
  return 0;
}
