"""Numbers that the compiled and the torch kernels of the noise share, so that both draw the same words."""

# words: multipliers of Wellons' triple32 (an integer hash of very low bias), the golden ratio's as the stride
MULTIPLIERS = (0xED5AD4BB, 0xAC4C1B51, 0x31848BAB)
STRIDE = 0x9E3779B9
# keys of rows: Steele, Lea and Flood, splitmix64
MIX_64 = (0xBF58476D1CE4E5B9, 0x94D049BB133111EB)
STEP_64 = 0x9E3779B97F4A7C15

# what a random word is for; a frame keeps its bytes as long as these keep their numbers
STAGE_QUANTA, STAGE_FEW_QUANTA, STAGE_ELECTRONICS = 0, 1, 3

# ln(1 + x) = x - x^2 / 2 + x^3 P(x) for sqrt(1/2) <= 1 + x < sqrt(2), highest power first (Moshier, Cephes logf)
LOGARITHM = (
    7.0376836292e-2,
    -1.1514610310e-1,
    1.1676998740e-1,
    -1.2420140846e-1,
    1.4249322787e-1,
    -1.6668057665e-1,
    2.0000714765e-1,
    -2.4999993993e-1,
    3.3333331174e-1,
)
# sin(2 pi v) = v P(v^2), cos(2 pi v) = P(v^2) for |v| <= 1/2, lowest power first; Chebyshev fits, 6e-7 and 4e-7
SINE = (6.283185005187988, -41.341590881347656, 81.59994506835938, -76.61447143554688, 41.3428840637207, -12.471243858)
COSINE = (
    1.0,
    -19.73920440673828,
    64.93911743164062,
    -85.45014190673828,
    60.16762924194336,
    -25.967599868774414,
    6.52865839,
)

# Poisson numbers of this mean or more come from the expansion of their quantile in normal numbers, fewer from inversion.
# At 20 and 1e7 draws the expansion adds 1.3 to a chi-square and shifts mean, variance and skewness by less than 0.15
# standard errors; it gets better as 1 / mean^3.
EXPANSION_FROM = 20.0
MOST_QUANTA = 1e30  # so that extreme settings end in noise, not in NaN

TAPS_TOGETHER = 8
