"""Floating-point operations of the kernels' formulas, for comparing time with a measured limit.

Counted per pixel (or value) and as the formula stands: an addition, multiplication, division or square root is 1, a
fused multiply-add 2, comparisons, clamps, selections and integer operations 0. What is the same for a whole row of
pixels is not counted. exp, log and Phi count as the vector forms of cl/math/lanes.clh do, on every device, however it
computes them: so a faster form of them shows as a larger share of the limit. The shapes' own sums are in shapes.py.
"""

from __future__ import annotations

EXP = 15  # argument reduction 5, polynomial of degree 5: 10
LOG = 20
LOG1P = 25  # log, and what 1 + x lost
PHI = 29  # square 1, scaled 2, polynomial of degree 12: 24, last step 2
DENSITY = 3 + EXP  # phi = c exp(-z z / 2)

QUADRATIC = 4  # two multiply-adds in dx; their coefficients belong to the row
MOMENTS = 10  # w dx, w dy, w dx^2, w dx dy, w dy^2, added up

# Around a shape's alpha: dx 1, T (1 - alpha) 2, weight 1, three colours 6.
BLEND = 10
# dx 1, T and weight 3, colour . v_color 5, the rest behind 2, v_alpha 3 (one division), gradients of the colour 6.
BLEND_VJP = 20

# Per pixel and channel. A pair of the window: four maps along rows 16, along columns 12, three maps back 9 and 9; its
# centre 4, 4, 3 and 3. Sum and difference 3, SSIM, its gradient and the sums 41, the end 10.
LOSS = 5 * (16 + 12 + 9 + 9) + 4 + 4 + 3 + 3 + 3 + 41 + 10
ADAM = 14  # moments 7, corrections, root, epsilon and quotient 5, step 2
