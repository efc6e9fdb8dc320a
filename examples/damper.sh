#!/bin/sh
# Damper control as a shell pipe: the x axis gives way to the force on the sensor, with a velocity in
# proportion to it. 20 ms sample time, 2 s. The perl between the two is the gain: 5 (mm/s)/N; with -N each
# sample is a line of its own: time, number, force. (Many an awk holds lines back until its buffer is full.)
set -e
loops=${1:-100}
devin -t0.02 -n0pN -L"$loops" lord1 |
    perl -alne 'BEGIN { $| = 1 } print -0.005 * $F[2]' |
    devout -rv -L-1 -W mod0.xaxis
