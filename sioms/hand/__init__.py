"""Two-fingered planar hand: pure maps between joints, hand coordinates, contacts and forces.

No process, no clock, no I/O.  SI units: m, rad, N, N m.  Angles are counter-clockwise.

* `kinematics`: joints of two modules and the six hand coordinates;
* `contacts`: normals, contact points and friction angles of a grasp, and what is said of it;
* `statics`: grasp matrix, internal force, and its sampled control loop;
* `control`: the laws that move the hand, sample by sample;
* `regrasp`: where the fingers go for a parallel grasp;
* `rolling`: rigid fingers rolling on an object without slip;
* `shape`, `around`: outlines that touches let expect, of a few squeezed ones and of many light ones;
* `touch`, `motions`, `feeling`, `skills`: what a skill sees and asks for, motions, touches with one finger, and the
  skills: grasp, sense, classify, regrasp, roll, hold;
* `plane`, `trials`: a hand in a simulated plane in one process, and random objects for it.
"""
