"""Floating-point operations of the kernels' formulas, to compare times with a measured limit.

The numbers are per pixel or per value, and follow the formula. An addition, multiplication, division or square root is
1 operation, a fused multiply-add is 2. Comparisons, clamps, selections and integer operations are 0. A term that is
constant along a row of pixels is not counted. exp, log and Phi have the operations of their vector forms
(cl/math/approx.clh) on every device. So a device that computes them faster reaches a larger share of the limit.
`Shape.flops` has the sums of each shape.
"""

from __future__ import annotations

EXP = 15  # argument reduction 5, polynomial of degree 5: 10
LOG = 20
LOG1P = 25  # log, and the rounding error of 1 + x
PHI = 29  # square 1, scaled 2, polynomial of degree 12: 24, last step 2
DENSITY = 3 + EXP  # phi = c exp(-z z / 2)

QUADRATIC = 4  # two multiply-adds in dx; their coefficients belong to the row
MOMENTS = 10  # the five products w dx, w dy, w dx^2, w dx dy, w dy^2 and their sums

# Operations of a pixel besides the shape's alpha: dx 1, T (1 - alpha) 2, weight 1, three colours 6.
BLEND = 10
# The same for the gradient: dx 1, T and weight 3, colour . v_color 5, the colour behind the splat 2, v_alpha 3 (one
# division), gradients of the colour 6.
BLEND_VJP = 20

# Operations of the loss per pixel and channel. Each of the five pairs of the window: four maps along rows 16 and along
# columns 12, three gradient maps 9 and 9. The centre of the window: 4, 4, 3 and 3. Sum and difference of the images 3,
# SSIM with its gradient and the sums 47, the final gradient 11.
LOSS = 5 * (16 + 12 + 9 + 9) + 4 + 4 + 3 + 3 + 3 + 47 + 11
ADAM = 14  # moments 7; corrections, root, epsilon and quotient 5; step 2
