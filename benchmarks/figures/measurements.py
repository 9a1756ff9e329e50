"""Which command measures what: one stored result each.

`DATA` is the folder of recordings (`--data`).
"""

MEASUREMENTS: dict[str, str] = {
    "ekf": "python -m benchmarks.ekf --runs 60 --seed 701 --json",
    "ekf_speed": "python -m benchmarks.ekf_speed --seed 702 --json",
    "servo": "python -m benchmarks.servo --trials 100 --seed 703 --json",
    "parking": "python -m benchmarks.parking --seed 704 --json",
    "navigate": "python -m benchmarks.navigate --runs 10 --seed 705 --json",
    "explore": "python -m benchmarks.explore --robots 1 --minutes 3 --seed 706 --json",
    "landmarks": "python -m benchmarks.landmarks --seed 707 --json",
    "relocalize": "python -m benchmarks.relocalize --nodes 1000 100000 --no-peer --ceilings --seed 708 "
    "--json",
    "merge": "python -m benchmarks.merge --runs 6 --seed 709 --json",
    "merge_scale": "python -m benchmarks.merge --scale 10000 --seed 710 --json",
    "merge_sim": "python -m benchmarks.merge_sim --scenarios office --runs 1 --seed 712 --json",
    "kitti_two": "mapweave eval merge DATA/kitti03 --robots 2 --json",
    "kitti_three": "mapweave eval merge DATA/kitti03 --robots 3 --json",
    "rules_fleets": "python -m benchmarks.rules --fleets 30 --seed 721 --json",
    "rules_twins": "python -m benchmarks.rules --twins 100 --seed 752 --json",
    "rules_singles": "python -m benchmarks.rules --singles 200 --seed 864 --json",
    "rules_graphs": "python -m benchmarks.rules --g2o DATA/posegraph/intel.g2o DATA/posegraph/manhattan.g2o "
    "--json",
    "rules_trials": "python -m benchmarks.rules --trials warehouse twin-corridor --runs 2 --seed 722 --json",
    "rules_warehouse": "python -m benchmarks.rules --trials warehouse --runs 4 --seed 872 --json",
    "rules_places": "python -m benchmarks.rules --places 1000 --seed 865 --json",
    "rules_loops": "python -m benchmarks.rules --loops 10 --seed 861 --json",
    "rules_pairs": "python -m benchmarks.rules --pairs 400 --seed 863 --json",
    "rules_drives": "python -m benchmarks.rules --drives 2 --seed 862 --json",
    "rules_lies": "python -m benchmarks.liar --rules --jobs 2 --seed 757 --ways 'node at 1e9 m' "
    "'edges of 1e5 m' 'covariance of zero' 'greatest covariance' 'contradicting clocks' 'many epochs' "
    "'shuffled maps' 'copied places' 'half copied landmarks' --json",
    "lies_margins": "python -m benchmarks.liar --margins --seed 759 --json",
    "wrong_geometry": "python -m benchmarks.wrong_geometry --runs 1 --kinds slip carried --scenes room "
    "--seed 723 --json",
    "trust": "python -m benchmarks.trust --seed 9041 --json",
    "agent": "python -m benchmarks.agent --seed 724 --json",
    "geometry": "python -m benchmarks.geometry --recording DATA/kitti03 --seed 737 --json",
    "fleet": "python -m benchmarks.fleet --agents 10 50 200 1000 --seconds 30 --seed 733 --json",
    "fleet_disturbed": "python -m benchmarks.fleet --agents 1000 --disturb --seconds 30 --seed 739 --json",
    "shards": "python -m benchmarks.shards --shards 1 2 4 --store sqlite --seed 736 --json",
    "shards_postgresql": "python -m benchmarks.shards --shards 1 2 4 --store postgresql --seed 736 --json",
    "life": "python -m benchmarks.life --drives 6 --stops 4 --seed 713 --json",
    "life_year": "python -m benchmarks.life --drives 100 --seed 735 --json",
    "chaos": "python -m benchmarks.chaos --agents 5 --seconds 60 --seed 734 --json",
    "fuzz": "python -m benchmarks.fuzz --seconds 60 --seed 738 --json",
    "photographs_corridor": "mapweave eval relocalize DATA/corridor --json",
    "photographs_street": "mapweave eval relocalize DATA/kitti03 --json",
}
