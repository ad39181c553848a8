"""Colours of Okabe and Ito, which those with a colour vision deficiency can tell apart."""

BLUE, RED, GREEN, ORANGE = "#0072B2", "#D55E00", "#009E73", "#E69F00"
PINK, SKY, GREY = "#CC79A7", "#56B4E9", "#999999"
