-- Understood by SQLite and PostgreSQL alike.

-- The number of the job of which this one is a part; NULL if it is no part. A job waits until its parts have ended.
ALTER TABLE jobs ADD COLUMN parent BIGINT;
CREATE INDEX jobs_by_parent ON jobs (parent);
-- A claim looks for the latest claim of the submitter of each job that waits; with parts, many wait.
CREATE INDEX jobs_by_claim ON jobs (submitter, claimed_s);
