"""The content-addressed store: committed artifacts, drafts in the making, and what keeps them apart.

::

    store/render/<slug>-<12 hex of the key>/manifest.json items.jsonl rejects.jsonl parts/<digest>.tar files/ logs/
    store/render/<key>.partial/      the same in the making, with markers/ (finished parts), unfinished/ (parts of which
                                     an item failed) and state/ (run stages)

A committed artifact is never changed in place. Parts are written to a temporary name, flushed and renamed to their digest;
a marker then says that the part is finished. Killing a process anywhere leaves a complete artifact or a draft that the next
run continues.
"""

from pipeline.store.artifact import DRAFT, SCHEMA, Artifact, is_sound, place, read_draft
from pipeline.store.claim import Claim
from pipeline.store.draft import FINISHED, UNFINISHED, UNKNOWN, Attempt, Draft, PartWriter
from pipeline.store.folder import Store, history, iter_inputs, store_of
from pipeline.store.hashes import HashCache
from pipeline.store.listing import Listing, Row
from pipeline.store.record import RECORD_ID, Record, record_digest

__all__ = [
    "DRAFT", "FINISHED", "RECORD_ID", "SCHEMA", "UNFINISHED", "UNKNOWN",
    "Artifact", "Attempt", "Claim", "Draft", "HashCache", "Listing", "PartWriter", "Record", "Row", "Store",
    "history", "is_sound", "iter_inputs", "place", "read_draft", "record_digest", "store_of",
]  # fmt: skip
