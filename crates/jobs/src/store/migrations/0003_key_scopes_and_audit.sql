-- Understood by SQLite and PostgreSQL alike.

-- What a key may do, until when, and how often. Keys from before may do everything.
ALTER TABLE api_keys ADD COLUMN scope TEXT NOT NULL DEFAULT 'admin';
ALTER TABLE api_keys ADD COLUMN expires_s DOUBLE PRECISION;
ALTER TABLE api_keys ADD COLUMN requests_per_s DOUBLE PRECISION;

-- The id of the key that submitted the job, empty without a key, and when a worker claimed it last.
ALTER TABLE jobs ADD COLUMN submitter TEXT NOT NULL DEFAULT '';
ALTER TABLE jobs ADD COLUMN claimed_s DOUBLE PRECISION;
CREATE INDEX jobs_by_submitter ON jobs (submitter, state);

-- Who changed what. Rows are numbered by a counter, and the oldest are deleted.
INSERT INTO counters (name, value) VALUES ('audit', 0);
CREATE TABLE audit (
    number BIGINT PRIMARY KEY,
    time_s DOUBLE PRECISION NOT NULL,
    who TEXT NOT NULL,
    action TEXT NOT NULL,
    target TEXT NOT NULL
);
