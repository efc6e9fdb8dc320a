#!/bin/sh
# Damper control as a shell pipe: the x axis gives way to the force on the sensor, with a velocity in
# proportion to it. 20 ms sample time, 2 s. The awk between the two is the gain: 5 (mm/s)/N.
set -e
loops=${1:-100}
devin -t0.02 -n0 -L"$loops" lord1 |
    awk '{ for (i = 1; i <= NF; i++) printf "%g\n", -0.005 * $i; fflush() }' |
    devout -rv -L-1 -W mod0.xaxis
