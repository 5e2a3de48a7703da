"""Parameters of nodes say what they mean, and refuse what cannot be."""

import ast
from collections.abc import Iterator
from pathlib import Path

import pytest
import rclpy
from rclpy.context import Context
from rclpy.node import Node
from rclpy.parameter import Parameter

from cutting_trainer.node_common.parameters import parameter, seed_parameter
from cutting_trainer.node_common.share_folder import PACKAGES


def made(**values: object) -> Iterator[Node]:
    context = Context()
    rclpy.init(context=context, domain_id=99)
    overrides = [Parameter(name, value=value) for name, value in values.items()]
    try:
        yield rclpy.create_node('talker', context=context, parameter_overrides=overrides)
    finally:
        rclpy.shutdown(context=context)


def test_parameter_describes_itself_and_cannot_be_changed_after_the_start() -> None:
    for node in made(seconds=3.5):
        assert parameter(node, 'seconds', 0.0, 'duration [s]', within=(0.0, 10.0)) == 3.5
        said = node.describe_parameter('seconds')
        assert said.description == 'duration [s]' and said.read_only
        assert said.floating_point_range[0].to_value == 10.0
        assert not node.set_parameters([Parameter('seconds', value=4.0)])[0].successful
        parameter(node, 'scale', 1.0, 'share [-]', within=(0.0, 1.0), settable=True)
        assert node.set_parameters([Parameter('scale', value=0.5)])[0].successful
        assert not node.set_parameters([Parameter('scale', value=1.5)])[0].successful


@pytest.mark.parametrize('value', [-1, 'many', 1.5])
def test_value_that_cannot_be_is_refused_with_name_range_and_meaning(value: object) -> None:
    for node in made(seed=value):
        with pytest.raises(ValueError, match=r'seed of talker must be of type int, 0 to .*random'):
            seed_parameter(node)


def test_no_node_has_a_parameter_without_a_description() -> None:
    for folder in ('tissue_sim', 'haptic_bridge', 'cutting', 'bags', 'viewer', 'session'):
        for path in (PACKAGES / folder).rglob('*.py'):
            for call in ast.walk(ast.parse(Path(path).read_text(encoding='utf-8'))):
                if isinstance(call, ast.Call) and getattr(call.func, 'attr', '') == (
                    'declare_parameter'
                ):
                    assert path.name == 'parameters.py', (
                        f'{path}: use cutting_trainer.node_common.parameters'
                    )
