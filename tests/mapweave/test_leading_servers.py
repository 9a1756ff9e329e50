"""What `mapweave status` says of servers that share a store."""

from mapweave.commands.status import leading

FOLLOWS = {"name": "s1", "leads": False, "leader": "s0", "behind": 3, "merges_itself": ""}
LEADS = {"name": "s0", "leads": True, "leader": "s0", "behind": 0, "merges_itself": ""}
ALONE = {"name": "s2", "leads": False, "leader": "s0", "behind": 0, "merges_itself": "of another version"}


def test_it_says_who_leads_who_follows_and_who_merges_itself():
    assert leading([FOLLOWS, LEADS, ALONE]) == [
        "server s0 leads",
        "server s1 follows s0, 3 changes behind",
        "server s2 merges itself: of another version",
    ]


def test_it_says_for_how_long_a_server_is_behind_and_what_delays_it():
    late = FOLLOWS | {"unmerged_s": 75.3, "delay": "s0 leads, and says: merging failed: see the server's log"}
    assert leading([LEADS, late])[1] == (
        "server s1 follows s0, 3 changes behind for 75 s: "
        "s0 leads, and says: merging failed: see the server's log"
    )
    assert leading([LEADS, FOLLOWS | {"unmerged_s": 0.4, "delay": ""}])[1].endswith(", 3 changes behind")


def test_it_says_which_server_waits_for_its_store():
    waits = {"name": "s1", "summary": "waiting: refused", "event": "waiting: refused", "loading": True}
    assert leading([LEADS, waits]) == ["map server s1 is waiting: refused"]
    assert leading([waits]) == ["map server s1 is waiting: refused"]


def test_of_a_server_without_others_it_says_nothing():
    assert leading([LEADS]) == leading([{"summary": "no nodes"}]) == leading([]) == []


def test_it_says_that_stores_exchange_no_decisions():
    one, other = {"summary": "no nodes", "constraints": 2}, {"summary": "no nodes", "constraints": 2}
    words = "2 servers have 2 stores, which do not exchange decisions"
    assert leading([one, other]) == [words]
    assert leading([one, {**other, "constraints": 0}]) == [f"{words}; constraints in force: 0, 2"]
    assert leading([LEADS, FOLLOWS, one])[0].startswith("3 servers have 2 stores")
    assert not any("stores" in line for line in leading([LEADS, FOLLOWS]))
