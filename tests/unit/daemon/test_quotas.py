"""Quotas: who is over which, and places that are kept."""

from sioms.daemon.config import QuotaTable
from sioms.daemon.quotas import Quotas, why_full
from sioms.daemon.rights import Peer

EVA, ROOT, OWNER = (Peer(1, uid, name, frozenset()) for uid, name in ((1000, "eva"), (0, "root"), (7, "sioms")))


def test_a_quota_is_named_with_its_setting_and_some_may_have_more():
    quotas = Quotas(QuotaTable(markers=10), owner=7)
    assert quotas.over(EVA, "markers", 9, "markers") == ""
    assert quotas.over(EVA, "markers", 10, "markers") == (
        "user eva has 10 markers, and at most 10 are allowed (markers of [quota])"
    )
    assert "at most 10" in quotas.over(EVA, "markers", 8, "markers", 3)
    for peer in (ROOT, OWNER):
        assert quotas.over(peer, "markers", 39, "markers") == ""
        assert "at most 40 are allowed (markers of [quota], 4 times as many" in quotas.over(
            peer, "markers", 40, "markers"
        )


def test_places_are_kept_for_who_may_stop():
    assert why_full(239, 5, 256, may_stop=False) == ""
    assert "16 places are reserved" in why_full(240, 0, 256, may_stop=False)
    assert "16 places are reserved" in why_full(240, 2, 256, may_stop=True)
    assert why_full(240, 0, 256, may_stop=True) == why_full(255, 1, 256, may_stop=True) == ""
    assert "max_sessions of [workcell] allows 256" in why_full(256, 0, 256, may_stop=True)


def test_one_user_leaves_room_for_others():
    table = QuotaTable()
    most = Quotas(table, owner=7).most(0, "sessions")
    assert most < 256 - 256 // 16 and Quotas(table, owner=7).most(0, "silent") < most
