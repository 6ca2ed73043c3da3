"""Jung and Chung's calibration of a differential drive from the heading errors of closed squares driven both ways.

C. Jung, W. Chung, "Accurate calibration of two wheel differential mobile robots by using experimental heading errors",
IEEE International Conference on Robotics and Automation (ICRA), 4533-4538 (2012). It takes the squares of UMBmark, of
side L from a corner, clockwise (cw) and counter-clockwise (ccw), but the error e (rad) of the final heading, true less
that of the odometry, with the means e_cw and e_ccw. A wheelbase error turns the robot too little by alpha at each of
four corners, whichever way; unequal wheels turn it by beta along each of four sides, to the same side:

    alpha = (e_cw - e_ccw) / 8,    beta = (e_cw + e_ccw) / 8.                                         (1)

Unequal wheels also change the turn at a corner, along the way pi b_0 / 4 of each wheel, b_0 being the design wheelbase:

        gamma = pi b_0 beta / (4 L).                                                                      (2)

The true wheelbase b, and the ratio of the right wheel's diameter to the left one's, are

    E_b = (pi/2) / (pi/2 - (alpha + gamma)),    b = E_b b_0,                                          (3)
    R = (L/2) / sin(beta/2),    E_d = (R + b/2) / (R - b/2),                                          (4)

and with the mean diameter D kept, which squares do not show,

    D_right = 2 D / (1 + 1/E_d),    D_left = 2 D / (1 + E_d).                                         (5)

The article itself was not at hand. Formulas (1) to (5) are those that the authors of OptiOdom (J. Intell. Robot. Syst.
105:39, 2022) use for it. Two things are to be known about them.

- (2) is what a wrong right wheel beside a left one of design size makes. The correction (5) changes both and keeps
  their mean, which does not change a turn on the spot, so that (3) and (5) together make the wheelbase longer by the
  share (E_d - 1) / 2 than the headings say. It is kept as it is used; wheels that differ by 0.1 % make that 0.05 %.
- OptiOdom's program divides the mean angles e_cw and e_ccw by the number of runs once more, in its file
  computeEvaluationMeasures.m. Here they are the means, so that all of the heading errors is corrected, not a part.

Reconstructed here, and not the article's own:

- the odometry is that of the design matrix on the recorded wheel rates, and L a quarter of the way that it measures;
- where the wheels' design diameters differ, (5) multiplies each of them, and E_d is the ratio of these factors;
- a tracked point off the axle's middle is taken there by its design pose before anything is measured;
- a run counts as a square if its odometry stands at the corners of one after each quarter of its way.

It is for two measured wheels on one axle (m, rad, SI throughout), for runs of one session, and uses the squares among
these.
"""

from __future__ import annotations

import math

from omnibench.fit.article_methods import SquaresMethod
from omnibench.registry import calibrators


@calibrators.register("jung_chung")
class JungChung(SquaresMethod):
    """Jung and Chung 2012: wheelbase and wheels from the final headings of squares driven both ways."""

    coordinate = 2

    def factors(self, clockwise: float, counter: float, side: float, axle: float) -> tuple[float, float]:
        """Formulas (1) to (4) of the mean heading errors, rad."""
        alpha, beta = (clockwise - counter) / 8, (clockwise + counter) / 8  # Eq. (1)
        gamma = math.pi * axle * beta / (4 * side)  # Eq. (2)
        wheelbase = (math.pi / 2) / (math.pi / 2 - (alpha + gamma))  # Eq. (3)
        bend = wheelbase * axle * math.sin(beta / 2) / side  # b/2 over R, which is infinite where beta is 0
        return wheelbase, (1 + bend) / (1 - bend)  # Eq. (4)
