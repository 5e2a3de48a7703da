"""Files that are made to harm their readers: YAML that multiplies, MCAP that unpacks to more
than a machine has, definitions without end.
"""

BILLION = '\n'.join(
    ['a0: &a0 [x, x, x, x, x, x, x, x, x, x]']
    + [f'a{n}: &a{n} [{", ".join(10 * [f"*a{n - 1}"])}]' for n in range(1, 40)]
)
"""Ten to the power of 40 values by aliases, in less than 3 kB."""

HOSTILE_YAML = {
    'aliases': BILLION,
    'lists 900 deep': '[' * 900 + ']' * 900,
    'lists 100,000 deep': '[' * 100_000,
    'mappings 900 deep': '{a: ' * 900 + '}' * 900,
    'blocks 900 deep': '\n'.join(f'{" " * n}a:' for n in range(900)),
    'ten megabytes': 'tool:\n' + '  # nothing\n' * 900_000,
    'too many values': 'tool: [' + '1, ' * 20_000 + '1]',
    'a key of 100 kB': f'? {"k" * 100_000}\n: 1',
    'a number of 20,000 digits': 'tool: {radius: ' + '9' * 20_000 + '}',
    'a list that contains itself': 'tool: &a [*a]',
    'a key twice': 'tool: {}\ntool: {}',
    'an object of Python': 'tool: !!python/object/apply:os.system ["true"]',
    'a date that is none': 'tool: 2001-99-99',
    'control characters': 'tool: "\x07"',
    'not text': b'tool: \xff\xfe\x00',
    'a null byte in a path': 'tissue: {mesh: "a\\0b"}',
}
"""Texts by their defect; every reader of YAML rejects each in one sentence."""
