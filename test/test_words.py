"""Claims about the words of the source; `bench/terminology.py` has the list."""

from bench.terminology import replaced_names, summaries_without_verb, what_clauses


def test_no_name_has_a_word_for_which_there_is_a_standard_term() -> None:
    assert not replaced_names()


def test_docstrings_begin_with_a_verb_and_rarely_say_what() -> None:
    what, words = what_clauses()
    assert what <= 1e-3 * words
    assert not summaries_without_verb()
