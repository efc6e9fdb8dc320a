"""Every threshold that decides what a verdict says: what it separates, and the data it was set on.

Both stacks, of axes and of sensors, read this table. Numbers in brackets are decisions; "forty axes" are those of
docs/reconcile.md, "Figures", and the sets A to I those of its second generator. Where no data are named, none are on
record. Numbers that only steer the work (grids, steps of a fit, sizes of blocks) stand where they are used.
"""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True, slots=True)
class Footing:
    """Thresholds that axes and sensors have alike, but not of one value: the floor of an axis is an expected
    innovation, that of a sensor the scatter of its own rows.

    Attributes:
        floor: a search stops at this multiple of the floor. Axes: 1.05 instead of 1.15, set A (0073); 120 force sensors
            were no better with 1.05 (0074).
        tries: candidates refitted in a step.
        steps: steps of a search at most.
        paired: two effects are tried at once only above this multiple. Sensors: set of a fresh origin (0072).
        odd: nothing is called unexplained below this multiple.
        trace: what an effect of natural size must leave to be ranked: on axes over the floor, root mean square; on
            sensors in standard deviations of all rows.
    """

    floor: float
    tries: int
    steps: int
    paired: float
    odd: float
    trace: float


AXIS = Footing(floor=1.05, tries=4, steps=6, paired=1.5, odd=1.25, trace=0.15)
SENSOR = Footing(floor=1.15, tries=5, steps=8, paired=1.3, odd=1.15, trace=6.0)

# --- when records contradict themselves

TWICE = 0.9
"""Rows come twice where so many of every other pair are equal in position and force, and the others are not. Forty
axes: 0.07 at most; doubled rows 1 (0562)."""
NOISY = 0.2
"""A position whose third differences hold this share of its spread is noise, or in no order of time. Forty axes: 0.011
at most; white noise 1 (0562)."""
SMOOTHER = 0.7
"""Neighbouring rows have changed places where the third differences of the position are less than this share with every
two of them exchanged. 336 records of drawn and stored axes: 1.003 at least, of an encoder that hardly counts, else 1.5;
with rows exchanged 0.01 at the median and 0.64 at most, but for two of that encoder (0890)."""
JUMP_TIMES, JUMP_COUNTS = 20.0, 8.0
"""A position leaps where its bend is so many times what it is in all but a fiftieth of the samples, and so many
counts. Forty axes: 4.2 times at most (0562)."""
LAWLESS = 0.5
"""A force of which the controller leaves more than this share is made by another one, or of another run. Forty axes:
0.0015 at most (0562)."""
UNRELATED = 0.3
"""Force and motion have nothing to do with each other where inertia, friction and forces of place together explain less
than this share of the force. Forty axes: 0.54 beside a gap, 0.74 else (0562)."""
FORETOLD = 0.5
"""... unless the force foretells this share of what is new in the acceleration on held-out rows: two inertias driven
about the frequency at which the second swings alone 0.9 and more; thirty sines of other phases, which a filter can turn
into one another, 0.34, other forces at most 0.002 (0770)."""
INERTIAS = 0.3, 21.0
"""The inertia that force and motion show is between these multiples of the nominal one, by a payload; beyond them it
is a unit, a sample time (every second row lost makes 0.25), or another axis. Forty axes: 0.51 to 2.95 (0562)."""
UNLIKE = 3.5
"""Records of one axis show inertias that differ by less than this factor. Forty axes: 2.8 under a drive that saturates,
1.3 else; every second row lost in one of them makes 4 (0562)."""

OTHER_RATE, LAW_TELLS, LAW_LEAST = 1.1, 3.0, 1e-3
"""A controller whose law holds the sample time tells it where it leaves so many times more of the force, and of more
than the last share of it, at a sample time that is the first times the stated one. Forty axes, whose laws hardly hold
it: 1.1 at most; a law with a derivative 50 and more (0661)."""

COLOURED, STEADY_ROWS, STRAYS, GOES_WITH = 8.0, 0.1, 0.04, 0.1
"""What a drive's law leaves is no noise where its steps from row to row have less than twice its squares by the second,
and by the first over the root of the rows (four standard errors of white noise). Of the mechanics nothing can be told
where that is above the third share of the force, and the command, present and past, foretells the last share of it on
parts of the records that were not fitted. Forty drawn axes: 1.92 to 2.02 where the law holds; 0.001 to 0.12 of a supply
that gives less at speed, 0.03 to 1.86 of a limited rate of change (1006). Foretold: see below (1047)."""
DOUBTED, SURELY_LAW, LITTLE_DOUBTED = 0.003, 0.02, 0.0003
"""The law of a drive is doubted where the command foretells so, of what it leaves, the first share of what no law
leaves; or, where it foretells more than the second share of what is left, the last. Twelve drawn drives with a delay,
a lag or a limit, and 80 made currents (white noise, 3 % of coloured noise or hum, coarse counts, held over 2 to 5
rows): less than 0.005 foretold in all. Three drawn limited rates: 0.037, 0.15 and 0.66 (0.003, 0.09 and 0.12 of what no
law leaves); made ones, second orders that noise does not hide, bent gains: 0.19 to 1 (1047)."""
LOCKED, MOSTLY_LOCKED = 0.02, 0.2
"""Something is missing where this share of the residual is one wave locked to the place; beside what is named, where it
is the second. Thirty-five drawn axes without one: 0.008 at most, of an encoder coarser than stated; 0.028 to 0.77 of an
error within the signal period (1006)."""
JITTERS, STAMPED = 0.02, 0.7
"""Rows come at no fixed rate where their steps vary by the first share, and were read at their stamps where the
position is rougher by the second on an even grid. Chosen: stamps that are late notes of even samples make it rougher at
the stamps (1042)."""
NEITHER = 2.0
"""Rows were read neither at their stamps nor evenly where both leave the position about as rough (``STAMPED``), by less
than this multiple of what the speed makes of the spread of the steps: more is noise. A device with news every 5 ms that
is polled every 10: 0.9; chosen (1042)."""
RESOLVES, FORETELLS = 0.02, 0.5
"""Rows resolve motion and force where the cubic through the four neighbours of each foretells it to within this share
of its spread: of a sine, some ten rows a period. What they resolve is proved afterwards, on every other row (1042)."""
STANDS = 0.5
"""A number that is found on every other row of a polled log differs by less than this share of it (1042)."""

# --- when an effect counts

GAIN = 0.05
"""Least share of what remains that an effect must save on held-out blocks. Forty axes (0063). A law of any form in the
place of a name: see 1043."""
SURE = 2.0
"""Least number of standard errors of that saving. Forty axes (0063)."""
PERIODIC_SURE = 3.0
"""The same for effects whose order is searched over tens of values. Forty axes (0063)."""
SPECIFIC = 0.3
"""A saving below this counts only where no unrelated effect saves ``NEARLY`` as much. Forty axes (0063); beside a gap
always, set D (0075).
"""
NEARLY = 0.5
"""See ``SPECIFIC``. Forty axes (0063)."""
DOUBTFUL = 0.2
"""A larger loss than this is one, however unevenly it falls on the blocks."""
CLEAR = 0.5
"""A step that saves this much needs no second look at the friction law; a searched order must save it in a refusal. Set
A (0073).
"""
LOOSE = 2.0
"""An effect does not make the error of the simulated closed loop this many times larger: an inertia so huge that it
does not listen to its force. Set A (0073).
"""
DEEP = 3.0
"""Standard errors, over all blocks, of a saving below the floor of a sensor. Where nothing is hidden none saved 0.03 of
everything; fingers and force sensors of a fresh origin (0074).
"""
BY_CHANCE = 3.0
"""A view of a sensor is above its floor where it is so by this many standard deviations of the root mean square of so
many rows of white noise, too: of 24 touches one in eight is above 1.15. A scatter that is told of few differences is
allowed as many. Recordings of one short session with other noise: of 417 two were wrong before, of 274 none (1026).
"""
PAIRS = 3
"""Firsts of two effects at once, each with the best few seconds."""

LARGEST = 30.0
"""Natural sizes that an effect may have to be searched for: a large drift in a short record, on sensors (0074). On
axes above the floor, after all that shows at its natural size: an eccentricity of ten times it, which left 0.05 of the
floor at one (1010)."""

REMAINS = 1.0
"""An effect that explains less than so many times what remains above the noise may be a part of that, and is told with
and without. Twenty-three axes of seeds 972801 and 972802: 0.3 twice, of effects that were not there; of those that were
13 and more (1041)."""
DWARFED = 0.02
"""Beside a nameless term an effect explains at least this share of what that does, or it may be what the term's form
lacks: a tanh for a dead band left 3 times the noise, of which a swinging load that was not there took half: 0.005 of
the term's (seed 972802, 1044)."""
CLIPPED = 0.1
"""Dry friction is less than none where terms that lower it take more than there is; in this share of the motion it is
no friction. Two axes of seeds 972801 and 972802 without the effect they hide: 0.73 and 0.48; what was there 0
(1041)."""

# --- when a confounder is ruled out

AMBIGUOUS = 0.015
"""Share of an effect's contribution that a confounder must miss: pairs made alike missed 0.0 to 1.3 %, pairs told apart
by full records 4 % and more. Forty axes (0063).
"""
ALIKE = 0.05
"""The same where the gate found one trace for both: gravity over 0.4 rad was told from a constant force that missed 2.2
%. Seeds 101 and 202 (0069).
"""
SAME_TRACE = 0.98
"""Share of energy in common from which on two traces are one, for ``ALIKE``. Seeds 101 and 202 (0069)."""
FAR_WORSE, EACH_BLOCK, NEARLY_EACH = 9.0, 4.6, 0.9
"""A confounder that misses less than ``AMBIGUOUS`` is ruled out all the same beside a model that comes down to the
noise, where it leaves so many times more squares in addition (so that nothing unmodelled in what that leaves could make
the difference), and where so large a share of the blocks of time tells it by itself: by the logarithm of the likelihood
of held-out rows, counted as independent ones, a hundred to one. Ten axes at one speed (seed 973102), where a transient
or two decide: up to 18 times, in 43 % of the blocks (one of seed 973101); rigs with dry and viscous friction: 18 to 72
times, in all (1046)."""
SAME = 0.95
"""The same for what the report says looks alike in these records."""
ROUGH = 0.1
"""What a confounder must miss beside a gap, whose bounces fall out otherwise with every other number. Eleven axes with
a gap (0080).
"""
SWAPS = 2
"""Confounders that take the place of what is named, one after the other."""

# --- when something is missing that has no name

UNEXPLAINED = 0.2
"""A generic smoother explains this share more than the named model. Forty axes (0063)."""
LARGE = 3.0
"""A residual beyond this multiple of the floor is no noise, whatever it looks like; beside a gap when bent (0080)."""
LOUD = 1.4
"""Above this multiple a nameless term is looked for though no smoother explains anything: a bend in force is no
function of motion. Set A (0073). That nothing is missing is not said above it: eight drawn axes with nothing hidden
and no measured current, whose noise is least known, leave 1.12 at most; a swinging load that the library had not, 2.8
(1045).
"""
QUIET = 1.6
"""Below this multiple nothing is called a burst; above it a sensor is searched again with nameless terms. 49 force
sensors, 35 fingers (0072).
"""
BURSTS = 0.8
"""The loudest tenth of the time holds this share of the residual's energy: a disturbance."""
MOSTLY, CHANCE = 0.5, 0.01
"""So large a share of the bursts at turns of the motion belongs to them, if chance brings it no oftener than this."""
BURST_S, LOUD_BLOCK, MOST_LOUD = 0.1, 6.0, 0.34
"""A block of so many seconds is loud above this multiple of the median energy; bursts are no larger share of the time
than the last.
"""
HOPELESS, HALF = 5.0, 0.33
"""Above this multiple, and with this share of the disagreement left, nothing is named at all."""
FREE_FLOORS, FREE_LEAST = 5.0, 0.05
"""A model that runs free is refused above this multiple of what noise makes of it, where that is also more than this
share of the motion, or of the force in closed loop; and what is taken for noise is below this share of the drive's
force. Seventeen of the forty axes: right models stay below 1.3 in closed loop (0560)."""
REFUTED = 0.67
"""A floor of which a model leaves less than this share is none: beside impacts and saturation small noise makes large
differences. Seventeen of the forty axes: 0.97 to 1.21, 0.26 beside a gap, 0.40 under a saturating drive (0561)."""
FREE_SHARE = 0.15
"""Without a closed loop a model runs free to within this share of the motion over at least one length of segment, or
within ``FREE_NEAR`` floors over all. Seventeen of the forty axes: right models 0.006 to 0.026 over 0.25 s, 0.19 at one
cruising speed, where no motion is; a resonator whose spring hardens 0.3 (0560)."""
FREE_NEAR = 2.0
"""Above this multiple of its floor it is said how far a free run stays from it. Seventeen of the forty axes: 1.83 at
most (0560)."""
NOISE = 4.0 / 3.0
"""Up to this multiple of its floor a report says of what remains that it is noise: a floor is right within a third on
right models (0562)."""
STUCK = 0.2
"""A model is at rest during at most this share of the way that the machine went. Seventeen of the forty axes: none at
all (0560)."""
GIVEN_POWER = 0.02
"""What depends on speed gives at most this power to the axis, of the rated force's at the largest speed (0560)."""
WORSE = 1.1
"""A model that runs free comes no farther from untouched samples than this multiple of what the nominal model, or the
floor, does; and refined numbers are those of short windows within this multiple of the best. Five public records
(0780)."""
MISSED = 0.005
"""Beside a remainder an effect is a finding only where untouched samples, too, lose this share by its absence. Five
public records (0780)."""
WITHIN, WIDER = 4.0, 0.95
"""A refined inertia is within this multiple of the stated one while effects are searched; beyond it, beside all of
them, where a free run then leaves less than this share. A joint of an arm: 43 without, where nothing shows (0780)."""
WAVES = 1.5
"""A wave has a name where the travel holds so many of its periods: over less a smooth force of place looks like it.
The Silverbox, a resonator whose spring hardens, was named a wave of 0.87 of a period."""
REACHED = 0.5
"""Motion reaches the highest frequencies of a record, or a few readings are wrong, where the quietest ones hold less
than this share of the noise that third differences show."""
FELL = 0.7
"""The noise is taken again from what a search leaves when it fell below this share, and the search repeated."""

FORMULA = 0.05
"""A smooth law has the course of a formula of one number where that leaves less than this share of its squares over
its places; whether the formula does as well is then judged on held-out blocks. The law that viscous friction made
leaves 1e-5, a drag with the square of the speed 0.06 (0970)."""
PLACES_A_PERIOD = 1.0
"""Beside a nameless term of the place a periodic force keeps its name where a period is shorter than this many places
of a smooth law over the same travel, an eighth of it: what is longer, a law can be made of. Cogging that took two
periods a turn of a detent, on two turns: two places; true cogging of 14 periods a turn there 0.3 (0970)."""

UNEVEN, UNEVEN_PATH = 0.08, 0.5
"""What is named has another law where the first share of what remains is explained, surely, once its numbers may change
with a variable; of friction that builds up over a path, the second. Some hundred axes fitted with the right effects
(seeds 981601 to 981604 and the forty): 0.06 at most, of friction that builds up 0.36; fifteen confounders in the place
of other laws: 0.08 to 0.98, of friction that builds up 0.62 to 0.77 (1056). Seed 770003, not seen when they were set:
42 right axes 0.01 at most, of friction that builds up 0.28; of 24 near laws (seed 770004) 15 are beyond (1053)."""

EXPONENT, EXPONENT_PATH, EXPONENT_ERRORS = 0.1, 0.3, 3.0
"""What is named has another law where its exponent comes to another value by the first number at least, beside friction
that builds up over a path by the second, and by so many standard errors. Eighty-one drawn axes fitted with the right
effects (seeds 770002 and 770003): 0.012 at most at three standard errors, beside what builds up 0.11; confounders in
the place of forty near laws (seed 770004), 32 fits of 50: 0.14 and more (1053)."""
NEIGHBOUR, HANGS = 0.5, 0.1
"""The neighbours of a law differ from it in its exponent by the first number (one standard deviation: a drop with the
speed itself for one with its square is two), which intervals have room for. Chosen. An effect whose size changes by
the second share with a bend is refused with the law that is bent. Chosen: what changes by less is told as wide (1053).
"""

# --- what keeps time

HALVED, ROUGHLY, ABOUT = 0.5, 2.0, 1.25
"""A change in time leaves at most the first share of what else would be left above the noise; of several that leave
about the same, or no more than noise, the one with the fewest numbers is taken. Fifteen axes of the second generator
(0082)."""
PROMISING = 0.5
"""The course of a number is looked at closely where it leaves less than this share, whatever it is (0082)."""
EARNED, SECOND, REGULAR = 20.0, 0.6, 0.05
"""A switch saves so many times what it would of noise; a second number that switches with the first leaves at most this
share; switches come at regular times where their intervals differ by no more than the last. Fifteen axes (0082)."""
WHOLE_SWING = 1.0
"""The value about which a number swings is told by so many periods of the swing in the longest record: of less, value
and swing are one course. Friction that warmed up over 5 s: half a period, about a level of dry friction that there was
not (seed 972801, 1044)."""
TONE = 0.5
"""A line of this share of the residual's energy is no noise: of noise the strongest holds less than 0.1, of a vibration
0.9 and more. Set D (0075).
"""
OWN, PURE = 0.05, 0.5
"""A frequency is the motion's own where it holds the first share of the motion's speed, or is an upper one of what
holds the second. Set D (0075).
"""

# --- when an axis in production has drifted, and by what (the watch)
#
# "Seed 5": eight axes of ``sioms bench watch``, on which the watch was made (0621).

CHANGED = 30.0
"""Energy of a change along its best cause, in units of its variance, from which on there is one: 5.5 standard
deviations. Seed 5; of 36 axis-hours without a drift none reached it (0621)."""
LEAVES, RIVAL = 25.0, 16.0
"""What a named cause may leave of that energy, and by how much more every other must leave: 5 and 4 standard
deviations. Seed 5 (0621)."""
NEEDED = 20.0
"""A richer cause is taken where a simpler one leaves so much more. Seed 5 (0621)."""
BENT = 0.05
"""A drift bends what it does not change: by this share of its force. Seed 5 (0621)."""
AGREE, OPEN, OVER = 3, 9, 12
"""Judgements one after the other, of some 20 s of motion each, that agree before a drift has a name; before one without
is told; and that see none before it is over. Seed 5 (0621)."""
SERIOUS, SERIOUS_PLACE = 0.35, 2e-3
"""A drift is a major alarm from this share of the usual force on, or where a place or a play changes by this share of
the travel. Chosen, not measured."""

SMALLEST, BEHIND_PLAY = 0.5, 0.15
"""A play of at least this share of the smallest that has a column is seen, if at least this share of the mass is behind
it: less than what a motor's rotor leaves to any load (0971)."""
PUSHED_APART = 0.4, 5.0
"""Edges that inertia moves apart are those of a play that makes their shift where that is twice the shift, but for this
share, and where it is so many times its error; below that share it is none. Seed 97209 (0971)."""
ONE_FLANK_STAYS = 0.25
"""... and where one push leaves the edge where steady speed does, within this share of their distance: what yields
moves it by half of that with either. Seed 271127: 0.03 (1011)."""
YIELDS = 0.1
"""Of a play twice the shift of an edge, where one flank bears, or the distance of the flanks, is the size to within
this share: what the contacts yield. Seeds 97209 and 271127, 7 % at most (0971, 1011)."""
TOLD_PLAY = 0.2
"""A reference tells a play whose standard deviation is such a share of it. Seed 5 (0621)."""
FEW_STEADY, FEW_PUSHED, STUDENT = 6, 2, 2.4
"""Crossings of an edge that tell how far apart the flanks are, of which the outermost do not count; those under
acceleration that are needed each way; and what few tell is less sure by Student's factor, about 1 + this over the
degrees of freedom: 2.2 of two (1011)."""

SPEED_KNOWN = 0.02
"""The speed at which an edge is passed is known to within this share, as far as it may change (STEADY)."""
FEWEST_BLOCKS = 20
"""What is normal is not learnt from fewer blocks of 20 s of motion. Seed 5 (0621)."""
IDLE_SHARE = 0.006
"""Changes below this share of the usual force are of no interest, whatever the number. Chosen, not measured."""
IDLE_PLACE, IDLE_STEPS, IDLE_SCALE = 1e-5, 2.0, 2e-4
"""The same for the place of a reference, of the travel and in steps of the encoder, and for its scale. Chosen, not
measured."""
CARRIED = 0.08
"""Masses of moves that differ by this share of the least are of loads that change: cogging alone makes 4 %. Seed 5
(0621)."""
UNSEEN = 1.5
"""What varies in commissioning may vary by so many times as much (in variance): it has not seen everything. Seed 5
(0621)."""
HEAT_VISCOUS, HEAT_DRY, DAY_S = 0.1, 0.025, 86400.0
"""A day's temperature changes friction by such a share (one standard deviation): some 2 % a kelvin of a grease's
viscosity, a quarter of that for what is dry. A commissioning shorter than a day has not seen all of it (0621)."""
DEPENDENT = 2.0
"""Neighbouring rows and the model's own errors leave fewer independent rows than there are: at least so many times.
Seed 5 (0621)."""
MODEL_SHARE = 0.002
"""The model's own error, of the usual force, may look like any of its columns. Seed 5, slow moves (0621)."""
MOST_PLACE, MOST_SCALE = 0.1, 0.05
"""What place and play of a reference, of the travel, and its scale may be at most (one standard deviation): a pulley or
an encoder that is a quarter off does not get into production (0621)."""
MOST_LATE_S = 0.02
"""How late a reference may be told (one standard deviation): filters of inputs go from 0.1 to 20 ms, and buses are
polled every 1 to 20. Where only one speed is seen, play and lateness are not told apart (1040)."""
MASS_TOLD = 1e4
"""A mass is told by a move whose acceleration explains this many times what is left: to a percent (0621)."""

# --- stand-ins on sensors; all on fingers and force sensors of a fresh origin

UNSTEADY, SURELY = 0.5, 2.0
"""A name that changes by this share along a variable, at so many half intervals, is searched without (0074)."""
REFUSED = 3
"""Names that are refused one after the other."""
FEWER = 2
"""Times as few numbers has a nameless rule that takes the place of elements' own numbers (0074)."""
WHOLLY = 0.95
"""Share of a view that a name must save where the view stays above its floor: less may be a part of what has no name
(0074).
"""
MOST_INSIDE = 0.7
"""Share of the elements whose own number must be one that the effect can have (0072)."""
SHARPER = 0.6
"""Share of a stated floor below which the one told beside a model counts (0074)."""
FELT = 3.0
"""Standard deviations that an element's own number must make for its confounders to be told by it."""
