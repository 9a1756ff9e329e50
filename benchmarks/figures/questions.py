"""The questions of docs/figures.md, and from which results they are answered.

No number of a measurement stands here: `{path/of/keys:format}` is filled in from a result.
"""

from __future__ import annotations

from dataclasses import dataclass

INTRODUCTION = (
    "`python -m benchmarks.figures` writes this page from the results in [figures/](figures/); "
    "with `--run NAME` it measures first. No number is written by hand. *Asked* is what should hold. "
    "Where a [decision page](decisions/README.md) names a seed of this page, that decision was made with it."
)


@dataclass(frozen=True)
class Row:
    """One figure, or a few of one kind.

    Attributes:
        what: is measured.
        figure: template.
        source: name of the result.
        asked: value, empty where none is.
    """

    what: str
    figure: str
    source: str
    asked: str = ""


@dataclass(frozen=True)
class Question:
    """A table.

    Attributes:
        title: of the section.
        rows: of the table.
    """

    title: str
    rows: tuple[Row, ...]


FILTERS = Question(
    "How accurate and fast are the filters?",
    (
        Row(
            "mapping filter: error over that of a batch optimum, median and 90th percentile",
            "{rmse_ratio_to_batch_median:.3f}, {rmse_ratio_to_batch_p90:.3f}",
            "ekf",
            "median at most 1.02",
        ),
        Row(
            "the same with 30 % wrong tracks, over that without any",
            "{outlier30_ratio:.3f}, {outlier30_ratio_p90:.3f}",
            "ekf",
        ),
        Row(
            "mapping filter: normalised squared error of poses and landmarks (3 is ideal)",
            "{nees_pose:.2f}, {nees_landmark:.2f}",
            "ekf",
        ),
        Row(
            "localization filter: starts up to 1 m and 1 rad wrong that converge",
            "{localization_converged:.1%}",
            "ekf",
        ),
        Row(
            "mapping filter, a step with 30 landmarks: as robots run it; with FilterPy's algorithm; FilterPy",
            "{step_ms_n30:.2f}, {step_ms_n30_plain:.2f}, {filterpy_step_ms_n30:.2f} ms",
            "ekf_speed",
            "at most 0.5 ms",
        ),
        Row(
            "the same with 100 landmarks",
            "{step_ms_n100:.1f}, {step_ms_n100_plain:.1f}, {filterpy_step_ms_n100:.1f} ms",
            "ekf_speed",
        ),
    ),
)
DRIVING = Question(
    "Does a robot park, arrive and explore?",
    (
        Row(
            "servo on an exact unicycle: parked within 1 cm and 1 degree, never under 4 landmarks in view",
            "{success:.0%} of {trials}",
            "servo",
            "100 %",
        ),
        Row(
            "its way over the shortest that keeps the landmarks in view, median",
            "{path_ratio_median:.2f}",
            "servo",
        ),
        Row(
            "the same starts by greedy switching, and by a pursuit that ignores the field of view",
            "{rivals/greedy_2004/success:.0%}, {rivals/pursuit_without_fov/success:.0%}",
            "servo",
        ),
        Row(
            "parking with camera and filters from up to 2.5 m: within 1 cm and 1 degree",
            "{success:.0%} of {starts}",
            "parking",
            "100 %",
        ),
        Row(
            "its error, median and 95th percentile",
            "{error_m_median:.1m}, {error_m_p95:.1m} mm; {error_deg_median:.1f}, {error_deg_p95:.1f} degrees",
            "parking",
        ),
        Row(
            "navigation to a node at least 4 edges away: there, within 5 cm and 5 degrees, nothing touched",
            "{success:.0%} of {runs}",
            "navigate",
            "100 %",
        ),
        Row(
            "its error, median; its way over the shortest on the known floor",
            "{goal_error_m_median:.1m} mm, {goal_error_deg_median:.1f} degrees; {path_over_shortest:.2f}",
            "navigate",
        ),
        Row(
            "exploration, floor mapped a minute by one robot: by itself, by chance",
            "{area_per_minute_ours/1:.1f}, {area_per_minute_random/1:.1f} m²",
            "explore",
        ),
    ),
)
LANDMARKS = Question(
    "What does a node cost, and what does it keep?",
    (
        Row(
            "a node with 150 landmarks on the wire, framing included: mean, most",
            "{bytes_per_node:.0f}, {bytes_per_node_most:.0f} bytes",
            "landmarks",
            "at most 3 kB",
        ),
        Row(
            "right matches kept, of those that SIFT with 512 bytes a descriptor has",
            "{inliers_ratio_to_float_sift:.1%}",
            "landmarks",
            "at least 97 %",
        ),
    ),
)
LOST = Question(
    "Are lost robots answered rightly?",
    (
        Row(
            "a view up to 0.3 m and 10 degrees off a node, among 1 000 and 100 000 places: right within "
            "0.25 m and 5 degrees",
            "{sizes/1000/recall_at_1:.0%}, {sizes/100000/recall_at_1:.0%}",
            "relocalize",
        ),
        Row(
            "views of twin rooms, and of unknown buildings, answered with a place, among 1 000 and 100 000",
            "{sizes/1000/wrong/twins:.1%}, {sizes/1000/wrong/nowhere:.1%}; "
            "{sizes/100000/wrong/twins:.1%}, {sizes/100000/wrong/nowhere:.1%} of {queries} each",
            "relocalize",
            "none",
        ),
        Row(
            "features in, answer out, median among 1 000 places: by the clock, of the processor",
            "{sizes/1000/p50_ms:.0f}, {sizes/1000/cpu_p50_ms:.0f} ms",
            "relocalize",
            "at most 15 ms",
        ),
        Row(
            "the same among 100 000 places",
            "{sizes/100000/p50_ms:.0f}, {sizes/100000/cpu_p50_ms:.0f} ms",
            "relocalize",
            "at most 30 ms",
        ),
        Row(
            "real images of a corridor: single images answered rightly, within 2 m of driving",
            "{recall_at_1:.0%}, {recall_within_2m:.0%} of {expected}",
            "photographs_corridor",
        ),
        Row(
            "the same on a street (KITTI odometry 03); [more with the geometry that calibration finds]"
            "(decisions/corrected-geometry.md)",
            "{recall_at_1:.0%}, {recall_within_2m:.0%} of {expected}",
            "photographs_street",
        ),
        Row(
            "right of those that are answered, corridor",
            "{decided_precision:.0%}",
            "photographs_corridor",
            "99 %",
        ),
        Row(
            "right of those that are answered, street",
            "{decided_precision:.0%}",
            "photographs_street",
            "99 %",
        ),
    ),
)
MERGING = Question(
    "Are maps merged rightly?",
    (
        Row(
            "synthetic fleets with 80 and 90 % false links that are as good as with the true links known",
            "{fleets/all rules/80/good}, {fleets/all rules/90/good}",
            "rules_fleets",
        ),
        Row(
            "the same: joined by no true link",
            "{fleets/all rules/80/joined_falsely}, {fleets/all rules/90/joined_falsely}",
            "rules_fleets",
            "none",
        ),
        Row(
            "the same by pairwise consistency and graduated non-convexity (PCM and GNC), and by GNC alone",
            "{rivals/pcm_gnc/joined_falsely/80:.0%}, {rivals/pcm_gnc/joined_falsely/90:.0%}; "
            "{rivals/gnc/joined_falsely/80:.0%}, {rivals/gnc/joined_falsely/90:.0%} of {runs}",
            "merge",
        ),
        Row(
            "Intel and Manhattan split among four robots: chi-square over GTSAM's batch optimum",
            "{graphs/all rules/intel:.6f}, {graphs/all rules/manhattan:.6f}",
            "rules_graphs",
        ),
        Row(
            "a map of 10 000 nodes grows, processor time: a new node, verified; a merge after five nodes",
            "{scale/cpu_ms_per_node/10000:.0f} ms; {scale/cpu_ms_per_merge/10000:.0f} ms",
            "merge_scale",
            "a node at most 50 ms",
        ),
        Row(
            "false links there; memory of the server",
            "{scale/false_links/10000:.0f} of {scale/links/10000:.0f}; {scale/rss_mb/10000:.0f} MB",
            "merge_scale",
        ),
        Row(
            "simulated office, from the first image to the merged map: false links, wrong joins, error",
            "{false_links/office} of {links/office}, {false_merges/office}, "
            "{merged_ate_m_median/office:.0m} mm",
            "merge_sim",
            "none false",
        ),
        Row(
            "simulated warehouses and twin rooms on a corridor: false links",
            "{trials/warehouse/all rules/false_links} of {trials/warehouse/all rules/links}, "
            "{trials/twin-corridor/all rules/false_links} of {trials/twin-corridor/all rules/links}",
            "rules_trials",
            "none",
        ),
        Row(
            "four more warehouses of three robots: false links, wrong joins",
            "{trials/warehouse/all rules/false_links} of {trials/warehouse/all rules/links}, "
            "{trials/warehouse/all rules/false_merges}",
            "rules_warehouse",
            "none",
        ),
        Row(
            "a real street (KITTI odometry 03) cut into two robots: components, false links, error",
            "{components}, {false_links} of {links}, {merged_ate_m:.2f} m",
            "kitti_two",
            "one map",
        ),
        Row(
            "the same cut into three",
            "{components}, {false_links} of {links}, {merged_ate_m:.2f} m",
            "kitti_three",
            "one map",
        ),
    ),
)
LIFE = Question(
    "Does a map stay small?",
    (
        Row(
            "the same rooms mapped six times: active nodes over those of the first drive",
            "{growth:.2f}",
            "life",
        ),
        Row(
            "views answered rightly from the first drive, from the active nodes, from all nodes",
            "{recall_after_1:.0%}, {recall_after:.0%}, {recall_all_nodes:.0%}",
            "life",
        ),
        Row(
            "a year of a hundred drives: memory, time of a merge and store after the last drives over those "
            "about the fiftieth",
            "{memory_ratio:.2f}, {merge_ratio:.2f}, {store_ratio:.2f}",
            "life_year",
            "at most 1.2 each",
        ),
        Row(
            "views answered rightly then, and after ten drives",
            "{recall_after:.0%}, {recall_after_10:.0%}",
            "life_year",
        ),
    ),
)
LOSSLESS = Question(
    "Is anything lost?",
    (
        Row(
            "agents, servers, routers and PostgreSQL killed, frozen, cut off and behind lossy links for a "
            "minute, on SQLite and then on PostgreSQL: changes lost, duplicated, out of order, of so many "
            "sent; of these, later ones have replaced",
            "{lost}, {duplicated}, {out_of_order} of {sent}; {undone}",
            "chaos",
            "0, 0, 0",
        ),
        Row("kills with signal 9; all maps equal afterwards", "{kills}; {maps_equal}", "chaos", "True"),
        Row(
            "until both servers have acknowledged everything again, 95th percentile; longest time in which a "
            "lost robot gets no answer while a server or router dies",
            "{recovery_s_p95:.1f}, {relocalize_gap_s:.2f} s",
            "chaos",
            "no answer for at most 1 s",
        ),
    ),
)
FLEET = Question(
    "How many robots does a server carry?",
    (
        Row(
            "10, 50, 200, 1000 robots with a node every 10 s, on the server's machine: from a change to its "
            "acknowledgement, median; a bare Zenoh query answered after a bare SQLite commit",
            "{agents/10/ack_p50_ms:.0f}, {agents/50/ack_p50_ms:.0f}, {agents/200/ack_p50_ms:.0f}, "
            "{agents/1000/ack_p50_ms:.0f} ms; {floor_p50_ms:.1f} ms",
            "fleet",
        ),
        Row(
            "the 99th percentile",
            "{agents/10/ack_p99_ms:.0f}, {agents/50/ack_p99_ms:.0f}, {agents/200/ack_p99_ms:.0f}, "
            "{agents/1000/ack_p99_ms:.0f} ms; {floor_p99_ms:.1f} ms",
            "fleet",
            "500 ms",
        ),
        Row(
            "until an answer to a lost robot meanwhile, 95th percentile",
            "{agents/10/relocalize_p95_ms:.0f}, {agents/50/relocalize_p95_ms:.0f}, "
            "{agents/200/relocalize_p95_ms:.0f}, {agents/1000/relocalize_p95_ms:.0f} ms",
            "fleet",
            "250 ms",
        ),
        Row(
            "1000 changes within a second behind that: all acknowledged after",
            "{agents/10/burst_s:.1f}, {agents/50/burst_s:.1f}, {agents/200/burst_s:.1f}, "
            "{agents/1000/burst_s:.1f} s",
            "fleet",
        ),
        Row(
            "cores of 1000 robots' links, of the server, of its router",
            "{agents/1000/generator_cpu:.2f}, {agents/1000/server_cpu:.2f}, {agents/1000/router_cpu:.2f}",
            "fleet",
        ),
        Row("memory of the server with 1000 robots", "{agents/1000/server_rss_mb:.0f} MB", "fleet"),
        Row(
            "1000 robots while a slow, a frozen and a flooding one disturb: acknowledgement, 99th "
            "percentile; answers, 95th percentile; changes of the thousand without acknowledgement",
            "{agents/1000/ack_p99_ms:.0f} ms; {agents/1000/relocalize_p95_ms:.0f} ms; {agents/1000/unacked}",
            "fleet_disturbed",
            "500 ms; 250 ms; 0",
        ),
        Row(
            "1, 2, 4 shards of a Ray cluster on the two cores of the same machine: the same links as "
            "without; greatest difference of a pose",
            "{same_links}; {max_pose_difference_m:.3f} m",
            "shards",
            "True; 0.001 m",
        ),
        Row(
            "answers a second without a cluster, and with 1, 2, 4 shards",
            "{sizes/without/answers_per_s:.0f}, {sizes/1 shards/answers_per_s:.0f}, "
            "{sizes/2 shards/answers_per_s:.0f}, {sizes/4 shards/answers_per_s:.0f}",
            "shards",
        ),
        Row(
            "worker, shard, gateway, server and head are killed: lost, wrong; until answers are whole again, "
            "95th percentile",
            "{lost}, {wrong}; {recovery_s_p95:.1f} s",
            "shards",
            "0, 0",
        ),
        Row(
            "the same with two front servers on PostgreSQL, where the second one and the primary are killed "
            "as well",
            "{lost}, {wrong}; {recovery_s_p95:.1f} s",
            "shards_postgresql",
            "0, 0",
        ),
        Row(
            "there: the same links as without; greatest difference of a pose; answers a second with 1, 2, 4 "
            "shards of each front server",
            "{same_links}; {max_pose_difference_m:.3f} m; {sizes/1 shards/answers_per_s:.0f}, "
            "{sizes/2 shards/answers_per_s:.0f}, {sizes/4 shards/answers_per_s:.0f}",
            "shards_postgresql",
            "True; 0.001 m",
        ),
    ),
)
GEOMETRY = Question(
    "Is a wrongly declared geometry found?",
    (
        Row(
            "a street (KITTI odometry 03) with the camera 1 m too far ahead, 2 degrees aside, 3 degrees "
            "down, wheels 5 % too large, 50 ms of delay: error over that with the right geometry",
            "{ratios/camera 1 m forward:.2f}, {ratios/heading 2 deg:.2f}, {ratios/pitch 3 deg:.2f}, "
            "{ratios/wheel scale 5 %:.2f}, {ratios/delay 50 ms:.2f}",
            "geometry",
            "at most 1.3 each",
        ),
        Row(
            "every cause named; images used, least", "{diagnosed}; {frames_used:.1%}", "geometry", "True; 95%"
        ),
        Row(
            "error over that of the wheels alone with the same geometry, greatest",
            "{wheels_ratio:.2f}",
            "geometry",
            "at most 1",
        ),
    ),
)
HOSTILE_INPUT = Question(
    "What does hostile input do?",
    (
        Row(
            "mutated messages, files, images, settings and requests: inputs; crashes, hangs, invalid ones "
            "that are accepted",
            "{inputs}; {crashes}, {hangs}, {accepted_invalid}",
            "fuzz",
            "0, 0, 0",
        ),
        Row("memory at most", "{peak_rss_mb:.0f} MB", "fuzz"),
        Row(
            "a map server that lies to a lost robot, once in each way: drives; touches, false arrivals",
            "{drives}; {touches}, {false_arrivals}",
            "trust",
            "0, 0",
        ),
        Row(
            "the same: goals given up; robots that arrive once the answers are true",
            "{gave_up} of {drives}; {arrived_by_the_truth} of {drives}",
            "trust",
        ),
    ),
)
SMALL_COMPUTERS = Question(
    "What does an agent need?",
    (
        Row(
            "a tick of the whole agent on one core, base installation: median, 99th percentile by the clock",
            "{tick_ms_p50:.1f}, {tick_ms_p99:.0f} ms",
            "agent",
            "at most 10, 40 ms",
        ),
        Row(
            "the same by the processor time of the loop; a tick in which a node is made, by the clock",
            "{tick_cpu_ms_p50:.1f}, {tick_cpu_ms_p99:.0f} ms; {node_ms:.0f} ms",
            "agent",
        ),
        Row(
            "the same with numba: median, 99th percentile by the clock; memory",
            "{with_numba/tick_ms_p50:.1f}, {with_numba/tick_ms_p99:.0f} ms; {with_numba/rss_mb:.0f} MB",
            "agent",
        ),
        Row("memory; imports", "{rss_mb:.0f} MB; {import_s:.1f} s", "agent", "at most 300 MB, 2 s"),
        Row("wheels of the base installation", "{wheel_mb:.0f} MB", "agent"),
    ),
)
QUESTIONS = (
    FILTERS, DRIVING, SMALL_COMPUTERS, GEOMETRY, LANDMARKS, LOST, MERGING, LIFE, FLEET, LOSSLESS,
    HOSTILE_INPUT,
)  # fmt: skip
