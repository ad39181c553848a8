/* The type of all numbers, double or with RL_MPC_SINGLE float, and the functions of math.h for it */

#ifndef REAL_H
#define REAL_H

#include <math.h>

#ifdef RL_MPC_SINGLE
typedef float real;
#define atan2 atan2f
#define cos cosf
#define exp expf
#define fabs fabsf
#define fmax fmaxf
#define fmin fminf
#define fmod fmodf
#define log logf
#define pow powf
#define rint rintf
#define sin sinf
#define sqrt sqrtf
#define tanh tanhf
#else
typedef double real;
#endif

#endif
