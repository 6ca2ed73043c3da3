"""UMBmark: the two systematic errors of a differential drive from closed squares that are driven both ways.

J. Borenstein, L. Feng, "Measurement and correction of systematic odometry errors in mobile robots", IEEE Transactions
on Robotics and Automation 12:869-880 (1996). A robot drives a square of side L from a corner along its x axis,
clockwise (cw) and counter-clockwise (ccw). Let x be the end of the true path less that of the odometry, in the frame of
the start pose, and x_cw, x_ccw (m) its means over the squares of each way. To first order an error of the wheelbase
turns the robot too little by alpha (rad) at each corner, and unequal wheels by beta (rad) along each side:

    alpha = (x_cw + x_ccw) / (-4 L),    beta = (x_cw - x_ccw) / (-4 L).                                 (1)

The true wheelbase b is that of the design, b_0, times

    E_b = (pi/2) / (pi/2 - alpha),    b = E_b b_0,                                                   (2)

and a side that bends by beta is an arc of radius R, from which follows the ratio of the right wheel's diameter to the
left one's,

    R = (L/2) / sin(beta/2),    E_d = (R + b/2) / (R - b/2).                                           (3)

With the mean diameter D kept, which squares do not show, the diameters of the wheels are

    D_right = 2 D / (1 + 1/E_d),    D_left = 2 D / (1 + E_d).                                          (4)

The article itself was not at hand. Formulas (1) to (4) are those that the authors of OptiOdom (J. Intell. Robot. Syst.
105:39, 2022) use for it. Reconstructed here, and not the article's own:

- b in (3) is that of (2), as in OptiOdom; b_0 would change E_d - 1 by the share E_b - 1 of itself;
- the odometry is that of the design matrix on the recorded wheel rates, and L a quarter of the way that it measures;
- where the wheels' design diameters differ, (4) multiplies each of them, and E_d is the ratio of these factors;
- a tracked point off the axle's middle is taken there by its design pose before anything is measured;
- a run counts as a square if its odometry stands at the corners of one after each quarter of its way.

It is for two measured wheels on one axle (m, rad, SI throughout), for runs of one session, and uses the squares among
these. The formulas are of first order: a true E_b of 1.03 with E_d = 0.98 comes out as 1.024 and 0.983.
"""

from __future__ import annotations

import math

from omnibench.fit.article_methods import SquaresMethod
from omnibench.registry import calibrators


@calibrators.register("umbmark")
class Umbmark(SquaresMethod):
    """UMBmark (Borenstein and Feng 1996): wheelbase and wheels from the ends of squares driven both ways."""

    coordinate = 0

    def factors(self, clockwise: float, counter: float, side: float, axle: float) -> tuple[float, float]:
        """Formulas (1) to (3) of the mean x errors, m."""
        alpha = (clockwise + counter) / (-4 * side)  # Eq. (1)
        beta = (clockwise - counter) / (-4 * side)
        wheelbase = (math.pi / 2) / (math.pi / 2 - alpha)  # Eq. (2)
        bend = wheelbase * axle * math.sin(beta / 2) / side  # b/2 over R, which is infinite where beta is 0
        return wheelbase, (1 + bend) / (1 - bend)  # Eq. (3)
