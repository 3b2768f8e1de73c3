"""What protocol `paper` had to decide, because the paper does not say it or says two things about it.

Nothing here was chosen by looking at the paper's results: where nothing is published, the odds are even, the choice is
left to Reins's own policy, or the number is left out.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Final, NamedTuple

if TYPE_CHECKING:
    from app.governance.model import Json


class Unpublished(NamedTuple):
    """One decision: what it is about, what the paper says, what is done here, and which metrics hang on it."""

    parameter: str
    paper: str
    here: str
    affects: tuple[str, ...]

    def describe(self) -> dict[str, Json]:
        """Return it as plain data."""
        return {"parameter": self.parameter, "paper": self.paper, "here": self.here, "affects": list(self.affects)}


UNPUBLISHED: Final = (
    Unpublished(
        "shares of the profiles",
        "says uniform over four profiles, and that human-shared is roughly one third of the test distribution",
        "uniform; a type that every profile watches is then seen with their mean s, 0.6 (paper: .688 to .758)",
        ("RVDR", "UCR", "per_type"),
    ),
    Unpublished(
        "which breaches a capability can commit",
        "names missing permission, forbidden zone, restricted object (elsewhere also missing approval and disallowed "
        "mode), without their shares",
        "uniform over those that are possible under the policy for the capability and profile drawn; the share of "
        "missing permissions is what a static rule can catch",
        ("UAIR", "confusion", "ablations"),
    ),
    Unpublished(
        "forbidden zones by name",
        "does not say how a request leads into a zone",
        "by a point of the floor, a point to place at, or where an object is seen; no name of the shipped site leads "
        "into a zone, so that inspect_area, transport_object and operate_tool do not attempt one",
        ("UAIR",),
    ),
    Unpublished(
        "disallowed execution modes",
        "lists them among the violations of experiment 1, without an example",
        "drawn where a profile does not admit a mode; the shipped profiles admit both, so that none occurs",
        ("UAIR",),
    ),
    Unpublished(
        "what a human answers",
        "draws the approval at random in the human-override experiment, and says nothing elsewhere",
        "even odds in human override; elsewhere yes, but for the attempts whose breach is the missing approval: what "
        "admission or the guard should stop is not stopped by luck",
        ("UAIR", "human_override", "ablations"),
    ),
    Unpublished(
        "what the paper's own pipeline lets through",
        "UAIR .962; 17 of 507 unauthorized requests pass as 'context-dependent violations'",
        "not reproduced: admission and guard are the real ones",
        ("UAIR", "confusion"),
    ),
    Unpublished(
        "in which profiles zones are watched",
        "says that detection depends on whether the profile lists the zone; the lists are not given",
        "where policy has a watch rule for zones, which the shipped policy has in all four profiles",
        ("RVDR", "UCR", "per_type"),
    ),
    Unpublished(
        "what counts as unsafe continuation",
        "RVDR and UCR leave 16.5 % of the violations unexplained, and at s = 0 UCR is .796, not 1",
        "every violation that was not held or stopped counts, those that a profile does not watch for included, but "
        "for those of which policy warned; `classes` has the missed, the not watched and the warned apart",
        ("UCR", "sensitivity"),
    ),
    Unpublished(
        "what follows a detection",
        "every detected violation triggers a policy-compliant intervention",
        "what `intervene` answers to the watch rule; where policy only warns of people (reached in the sweep above "
        "s = 0.7 alone) the robot goes on, as policy wants: UCR and CEF leave those out",
        ("CEF", "UCR", "sensitivity"),
    ),
    Unpublished(
        "what a capability notices by itself",
        "reports RVDR .351 for capability-internal safety, without saying of what",
        "contact force and a lost grip (force, postcondition), with the same odds s as the watcher",
        ("RVDR", "UCR"),
    ),
    Unpublished(
        "why capability-internal safety enforces 60 %",
        "reports CEF .600 with no deviation, which looks like a constant",
        "not reproduced: a capability can only stop itself, and counts as enforcing where policy names a stop",
        ("CEF",),
    ),
    Unpublished(
        "which failures meet which capability",
        "lists four recoverable failures without shares",
        "uniform over four for every capability, as the six violations are, in trials of their own",
        ("RSR", "SRR", "RBSR", "RPC"),
    ),
    Unpublished(
        "how often a recovery step succeeds",
        "publishes 88-92 % per attempt of a rollback, and nothing else",
        "the same, drawn uniformly, for every governed recovery motion, which removes the cause of the failure; a new "
        "attempt without one succeeds with even odds; every method has the same luck in the same trial",
        ("RSR", "SRR", "RBSR", "RBSR_ALL"),
    ),
    Unpublished(
        "what counts as a successful recovery",
        "does not define RSR; .907 suggests that a rollback counts, 'safe recovery rate' appears once",
        "RSR: the goal is reached, within budget. SRR: that, or a verified rollback. After a timeout no budget is "
        "left: policy rolls back, and a new attempt is no success for any method",
        ("RSR", "SRR"),
    ),
    Unpublished(
        "the denominator of RBSR",
        "reports .533 over capabilities with and without a rollback",
        "RBSR over rollbacks tried; RBSR_ALL over failures after which the goal was not reached",
        ("RBSR", "RBSR_ALL"),
    ),
    Unpublished(
        "why recovery succeeds differently in methods that all lack it",
        "direct .334, static .460, AutoRT .320, RoboGuard .383",
        "not reproduced: each has the agent's one retry, so that they agree",
        ("RSR", "effect_sizes"),
    ),
    Unpublished(
        "the ad hoc fallback of the ablation without recovery",
        "RSR .311 without a recovery manager",
        "nothing recovers where recovery is taken out",
        ("RSR", "ablations"),
    ),
    Unpublished(
        "how long a recovery takes",
        "reports mean recovery times of 0.17 to 1.28 s from a model that is not given",
        "left out; protocol `physical` measures it",
        ("MRT", "MRT_SAFE", "MRT_RESUME"),
    ),
    Unpublished(
        "detection latency",
        "named as a metric, reported nowhere",
        "a coin has none; protocol `physical` measures it",
        ("DL_TICKS_MEDIAN", "DL_TICKS_P95", "DL_MS_MEDIAN", "DL_MS_P95"),
    ),
    Unpublished(
        "false alarms of the watcher",
        "argues with them, but does not measure them",
        "the coin is tossed only where there is a violation; protocol `physical` measures them",
        ("FAS",),
    ),
    Unpublished(
        "standard deviation over seeds",
        "does not say which",
        "of the sample (n - 1), as in Cohen's d",
        ("std", "effect_sizes"),
    ),
)
