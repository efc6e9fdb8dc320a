"""What is tried with a hand in a simulated plane, each experiment a function that returns its numbers.

The source's experiments and the acceptance of the hand are made of them. Objects and starts are stated exactly; the
estimator, its noise and the axes' resolution are in the loop, and the truth of the plane judges.

* `starts`: objects at a stated friction angle;
* `rolls`: rolling at constant speed, in the plane and rigidly;
* `regrasps`: the source's regrasps of disk and rectangle, and its classifier;
* `force`: the damper law at the end of its gains;
* `slips`: the friction cone, and ellipses that are lost or kept.
"""
