"""Metadata of exported sessions: origin, losses, result, and a pseudonym in place of a name."""

from pathlib import Path
from typing import Any

from cutting_trainer.bags.reader import Bag
from cutting_trainer.bags.recorded_tissue import tissue_at
from cutting_trainer.session.bag_measurements import lost_messages
from cutting_trainer.studies.bag_collection import StudyBag


class SessionMetadata:
    """Metadata of the sessions of one export, in which a subject has one number."""

    def __init__(self) -> None:
        self._subjects: dict[str, str] = {}

    def of(self, bag: StudyBag, opened: Bag) -> dict[str, Any]:
        """Return the metadata of a session.

        The scene's text and the parameters stay out: they may have names and paths.

        Raises:
            BagError: there is no tissue in it.
        """
        data = opened.custom_data
        subject = data.get('subject', '')
        if subject:  # it may have been given by a name
            subject = self._subjects.setdefault(subject, f'subject-{len(self._subjects) + 1}')
        return {
            'scene': Path(data.get('scene_file', 'tissue')).stem,
            'bag_hash': bag.hash,
            'format_version': data.get('format_version', ''),
            'subject': subject,
            'lost_messages': lost_messages(opened),
            'tissue_hash': f'{tissue_at(opened).hash():016x}',
        }
