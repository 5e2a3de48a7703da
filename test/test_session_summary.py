"""The summary of a session tells what its bag holds, and the verdict what is wrong with it."""

import dataclasses
import io
import json
import math
import signal
from pathlib import Path

import numpy as np
import pytest
from rich.console import Console

from cutting_trainer.bags.recorded_qos import OfferedQos
from cutting_trainer.bags.writer import BagWriter
from cutting_trainer.node_common.cdr_codec import ContactCodec, WrenchStampedCodec
from cutting_trainer.session.acceptance_criteria import Expected, judge
from cutting_trainer.session.bag_measurements import Evidence, Status, read_evidence
from cutting_trainer.session.outcome import Death, Outcome
from cutting_trainer.session.result_table import session_tables
from cutting_trainer.session.summary import Summary, summarise

RATES = {'tissue_sim': 30.0, 'haptic_bridge': 1000.0}
EXPECTED = Expected(RATES, cut=True)
FINISHED = Outcome(ran=True, finished=True, seconds=20.0)
GRANTED = 'real-time scheduling granted: SCHED_FIFO, priority 40'


def status(node: str, time: float, level: int = 0, message: str = '', **values: object) -> Status:
    return Status(time, node, level, message, {key: str(value) for key, value in values.items()})


def reports(node: str, rate: float, seconds: int = 20, **values: object) -> list[Status]:
    return [
        status(
            node,
            float(time),
            rate=rate,
            within=1.0,
            period_p99=1.02 / rate,
            lateness_p999=1e-4,
            missed=3,
            real_time=GRANTED,
            **values,
        )
        for time in range(1, seconds)
    ]


def session() -> Evidence:
    """Twenty seconds at 100 Hz with one contact from 5 s to 12 s under 0.8 N."""
    times = np.arange(0.0, 20.0, 0.01)
    touching = (times >= 5.0) & (times < 12.0)
    return Evidence(
        bag=Path('bags/sessions/block'),
        duration=20.0,
        contacts=np.column_stack([times, touching]),
        forces=np.column_stack([times, np.where(touching, 0.8, 0.0)]),
        statuses=[
            *reports('tissue_sim', 30.0, elements_cut=17),
            *reports('haptic_bridge', 999.0),
            *(status('recorder', float(t), received=100 * t) for t in range(1, 20)),
        ],
        messages={'/tool/contact': len(times), '/arm/servo_cf': len(times)},
    )


@pytest.fixture
def good() -> Summary:
    return summarise(session())


def test_session_that_did_what_it_should_has_no_failures(good: Summary) -> None:
    assert judge(good, FINISHED, EXPECTED) == []


def test_contact_time_and_forces_are_those_of_the_contact(good: Summary) -> None:
    assert good.contact_time == pytest.approx(7.0)
    assert good.largest_force == 0.8
    assert good.force_before_contact == 0.0
    assert good.force_after_contact == 0.0
    assert good.elements_cut == 17
    assert good.messages == 4000


def test_a_gap_in_the_messages_is_not_counted_as_contact() -> None:
    evidence = session()
    times = evidence.contacts[:, 0]
    evidence.contacts = evidence.contacts[(times < 6.0) | (times > 11.0)]
    assert summarise(evidence).contact_time == pytest.approx(1.0 + 0.1 + 1.0, abs=0.02)


def test_start_of_the_slowest_node_is_not_held_against_the_others() -> None:
    evidence = session()
    for index, old in enumerate(evidence.statuses):
        if old.node == 'haptic_bridge' and old.time <= 6.0:
            values = old.values | {'rate': '400', 'missed': '900'}
            evidence.statuses[index] = dataclasses.replace(old, values=values)
        elif old.node == 'haptic_bridge':
            values = old.values | {'missed': '904'}
            evidence.statuses[index] = dataclasses.replace(old, values=values)
    evidence.statuses += [status('cutting', 5.0), status('cutting', 7.0)]
    bridge = summarise(evidence).nodes['haptic_bridge']
    assert bridge.lowest_rate == 999.0
    assert bridge.missed == 4.0


def test_lowest_rate_and_worst_p99_are_of_one_report_the_rate_is_the_median() -> None:
    evidence = session()
    index = next(i for i, s in enumerate(evidence.statuses) if s.time == 10.0)
    slow = evidence.statuses[index].values | {'rate': '21', 'period_p99': '0.09', 'within': '0.5'}
    evidence.statuses[index] = dataclasses.replace(evidence.statuses[index], values=slow)
    node = summarise(evidence).nodes['tissue_sim']
    assert (node.rate, node.lowest_rate) == (30.0, 21.0)
    assert (node.within, node.lowest_within) == (1.0, 0.5)
    assert node.worst_period_p99 == 0.09 and node.period_p99 == pytest.approx(0.034)


def failures_of(good: Summary, **changes: object) -> list[str]:
    return judge(dataclasses.replace(good, **changes), FINISHED, EXPECTED)  # type: ignore[arg-type]


@pytest.mark.parametrize(
    ('changes', 'words'),
    [
        ({'complete': False}, 'was not closed'),
        ({'lost': {'/tissue/force': 3}}, '3 messages of /tissue/force were lost'),
        ({'contact_time': 0.0}, 'never touched'),
        ({'largest_force': 0.0}, 'never felt'),
        ({'force_before_contact': 0.1}, 'before the first contact'),
        ({'force_after_contact': 0.1}, 'still after the last contact'),
        ({'elements_cut': 0}, 'nothing was cut'),
    ],
)
def test_each_thing_that_went_wrong_is_one_sentence(
    good: Summary, changes: dict[str, object], words: str
) -> None:
    failures = failures_of(good, **changes)
    assert len(failures) == 1
    assert words in failures[0]


def test_messages_sent_before_the_recorder_knew_the_topic_are_no_loss(good: Summary) -> None:
    assert failures_of(good, missed={'/arm/measured_cp': 40}) == []


def test_script_without_a_cut_need_not_cut(good: Summary) -> None:
    uncut = dataclasses.replace(good, elements_cut=0)
    assert judge(uncut, FINISHED, Expected(RATES, cut=False)) == []


@pytest.mark.parametrize('factor', [0.85, 1.15])
def test_wrong_rate_is_told_with_both_numbers(good: Summary, factor: float) -> None:
    node = dataclasses.replace(good.nodes['tissue_sim'], rate=30.0 * factor)
    failures = failures_of(good, nodes=good.nodes | {'tissue_sim': node})
    assert len(failures) == 1
    assert failures[0].startswith(f'tissue_sim ran at {30 * factor:.4g} Hz instead of 30 Hz')
    assert ('./trainer plan' in failures[0]) == ('./trainer doctor' in failures[0]) == (factor < 1)


def test_node_that_never_reports_and_node_without_rates_are_told(good: Summary) -> None:
    nodes = {n: s for n, s in good.nodes.items() if n != 'tissue_sim'}
    assert failures_of(good, nodes=nodes) == ['tissue_sim never reported on /diagnostics']
    silent = dataclasses.replace(good.nodes['tissue_sim'], rate=math.nan)
    failures = failures_of(good, nodes=good.nodes | {'tissue_sim': silent})
    assert failures == ['tissue_sim never reported its rate on /diagnostics']


def test_a_session_too_short_for_reports_of_rates_is_judged_by_the_rest(good: Summary) -> None:
    nodes = {
        name: dataclasses.replace(node, rate=math.nan, lowest_rate=math.nan)
        for name, node in good.nodes.items()
    }
    short = dataclasses.replace(good, nodes=nodes)
    assert judge(short, dataclasses.replace(FINISHED, seconds=3.0), EXPECTED) == []
    assert len(judge(short, FINISHED, EXPECTED)) == len(RATES)


def test_error_on_diagnostics_is_told_and_a_warning_is_not() -> None:
    evidence = session()
    evidence.statuses.append(status('haptic_bridge', 8.0, 1, 'the simulation is silent'))
    assert judge(summarise(evidence), FINISHED, EXPECTED) == []
    evidence.statuses.append(status('haptic_bridge', 9.0, 2, 'no pose for 20 ms'))
    failures = judge(summarise(evidence), FINISHED, EXPECTED)
    assert failures == ['haptic_bridge reported an error: no pose for 20 ms']


def test_a_loop_that_got_no_turn_explains_an_error_and_is_none_by_itself() -> None:
    evidence = session()
    evidence.statuses.append(status('haptic_bridge', 8.0, period_max=0.033))
    evidence.statuses.append(status('tissue_sim', 8.0, period_max=0.05))
    assert judge(summarise(evidence), FINISHED, EXPECTED) == []
    evidence.statuses.append(status('haptic_bridge', 9.0, 2, 'no pose for 20 ms'))
    error, why = judge(summarise(evidence), FINISHED, EXPECTED)
    assert 'no pose' in error
    assert 'haptic_bridge did not run for 33 ms' in why


def test_deaths_come_first_with_signal_and_time(good: Summary) -> None:
    death = Death('cutting', -signal.SIGKILL, 12.34, ())
    outcome = dataclasses.replace(FINISHED, deaths=[death])
    failures = judge(good, outcome, EXPECTED)
    assert failures == ['cutting died after 12.3 s (killed by SIGKILL)']


def test_unfinished_script_is_a_failure_unless_the_user_interrupted(good: Summary) -> None:
    early = dataclasses.replace(good, contact_time=0.0, elements_cut=0)
    outcome = Outcome(ran=True, seconds=35.0)
    assert judge(early, outcome, EXPECTED)[0] == 'the arm did not finish its script within 35 s'
    outcome.interrupted = True
    assert judge(early, outcome, EXPECTED) == []


def test_summary_of_an_empty_bag_is_a_summary() -> None:
    empty = summarise(Evidence(Path('bag')))
    assert empty.contact_time == 0.0 and empty.force_after_contact is None
    assert 'the tool never touched the tissue' in judge(empty, FINISHED, EXPECTED)


def test_json_has_no_nan(good: Summary) -> None:
    text = json.dumps(good.plain(), allow_nan=False)
    assert json.loads(text)['nodes']['recorder']['rate'] is None


def test_table_names_every_node_and_where_the_bag_lies(good: Summary) -> None:
    console = Console(width=120, record=True, file=io.StringIO())
    console.print(session_tables(good))
    text = console.export_text()
    for word in ('tissue_sim', 'haptic_bridge', 'recorder', '7.0 s', '0.80 N', '17', good.bag):
        assert word in text


def test_evidence_is_what_was_written_into_the_bag(tmp_path: Path) -> None:
    contact, wrench = ContactCodec('tissue'), WrenchStampedCodec('arm_base')
    blank = [0 for _, code, count in ContactCodec.layout for _ in range(count)]
    writer = BagWriter(tmp_path / 'bag', custom_data={})
    qos = (OfferedQos(depth=1, reliability='reliable', durability='volatile'),)
    for topic, name in (('/tool/contact', 'Contact'), ('/arm/servo_cf', 'WrenchStamped')):
        writer.add_topic(topic, f'some_msgs/msg/{name}', '', '', qos)
    second = 1_000_000_000
    for number in (1, 2, 5):
        time = second + number * second // 10
        values = list(blank)
        values[ContactCodec.fields['state'].start] = int(number == 2)
        writer.write('/tool/contact', time, time, contact.encode(time, values), number)
        force = (3.0 * number, 4.0 * number, 0.0, 0.0, 0.0, 0.0)
        writer.write('/arm/servo_cf', time, time, wrench.encode(time, force), number + 6)
    writer.close()
    evidence = read_evidence(tmp_path / 'bag')
    assert evidence.complete
    assert evidence.messages == {'/tool/contact': 3, '/arm/servo_cf': 3}
    assert evidence.contacts[:, 1].tolist() == [0.0, 1.0, 0.0]
    assert evidence.forces[:, 1].tolist() == [5.0, 10.0, 25.0]
    assert evidence.duration == pytest.approx(0.4)
    assert evidence.lost == {'/tool/contact': 2, '/arm/servo_cf': 2}
    assert evidence.missed == {'/arm/servo_cf': 6}


def test_what_a_late_node_said_unheard_is_no_loss_of_the_others(tmp_path: Path) -> None:
    writer = BagWriter(tmp_path / 'bag', custom_data={})
    writer.add_topic('/parameter_events', 'some_msgs/msg/Event', '', '', (OfferedQos(),))
    for time, number in enumerate((1, 2, 3, 7, 4, 8), start=1):
        writer.write('/parameter_events', time, time, b'', number)
    writer.close()
    evidence = read_evidence(tmp_path / 'bag')
    assert evidence.lost == {}
    assert evidence.missed == {'/parameter_events': 6}
