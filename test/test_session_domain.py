"""Two sessions never share a ROS domain unknowingly."""

import os
import socket

import pytest

from cutting_trainer.session.domain import MAX_DOMAIN, parse_domain, reserved_domain
from cutting_trainer.session.errors import SessionError

DOMAIN = 83


def test_second_session_in_a_domain_is_refused_with_the_process_that_holds_it() -> None:
    with (
        reserved_domain(DOMAIN),
        pytest.raises(
            SessionError, match=rf'domain 83 already \(process {os.getpid()}\).*--domain'
        ),
        reserved_domain(DOMAIN),
    ):
        pass


def test_domain_is_free_again_after_its_session() -> None:
    for _ in range(2):
        with reserved_domain(DOMAIN) as domain:
            assert domain == DOMAIN


def test_free_domains_of_two_sessions_differ() -> None:
    with reserved_domain('free') as first, reserved_domain('free') as second:
        assert first != second
        assert min(first, second) >= 1 and max(first, second) <= MAX_DOMAIN


def test_domain_with_foreign_participants_is_not_free() -> None:
    with reserved_domain('free') as domain:
        pass
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as participant:
        participant.bind(('', 7400 + 250 * domain + 10))
        with reserved_domain('free') as other:
            assert other != domain


def test_domain_is_taken_from_the_option_then_the_environment_then_zero(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setenv('ROS_DOMAIN_ID', '7')
    assert [parse_domain(text) for text in ('free', '12', '')] == ['free', 12, 7]
    monkeypatch.delenv('ROS_DOMAIN_ID')
    assert parse_domain('') == 0


def test_nodes_that_may_not_find_one_another_make_no_session(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setenv('ROS_AUTOMATIC_DISCOVERY_RANGE', 'OFF')
    with pytest.raises(SessionError, match='ROS_AUTOMATIC_DISCOVERY_RANGE is OFF'):
        parse_domain('free')


@pytest.mark.parametrize('text', ['102', '-1', 'lab', '1.5'])
def test_domain_that_cannot_be_is_refused(text: str) -> None:
    with pytest.raises(SessionError, match='from 0 to 101'):
        parse_domain(text)
