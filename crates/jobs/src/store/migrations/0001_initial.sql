-- Understood by SQLite and PostgreSQL alike. Times are seconds since 1970, structured values JSON.

-- The row of a counter is also the lock that two enqueueing transactions meet at.
CREATE TABLE counters (
    name TEXT PRIMARY KEY,
    value BIGINT NOT NULL
);
INSERT INTO counters (name, value) VALUES ('job', 0);

CREATE TABLE jobs (
    number BIGINT PRIMARY KEY,
    kind TEXT NOT NULL,
    makes TEXT,
    state TEXT NOT NULL,
    spec TEXT NOT NULL,
    idempotency_key TEXT UNIQUE,
    progress TEXT NOT NULL,
    outcome TEXT,
    error TEXT,
    cancelling BIGINT NOT NULL DEFAULT 0,
    queued_s DOUBLE PRECISION NOT NULL,
    started_s DOUBLE PRECISION,
    ended_s DOUBLE PRECISION,
    -- Who works on it, until when that holds, and how often it was taken up: the last is the fencing token.
    owner TEXT,
    lease_until_s DOUBLE PRECISION,
    token BIGINT NOT NULL DEFAULT 0
);
CREATE INDEX jobs_by_state ON jobs (state, number);

CREATE TABLE job_logs (
    job BIGINT NOT NULL REFERENCES jobs (number) ON DELETE CASCADE,
    seq BIGINT NOT NULL,
    time_s DOUBLE PRECISION NOT NULL,
    line TEXT NOT NULL,
    PRIMARY KEY (job, seq)
);

CREATE TABLE job_losses (
    job BIGINT NOT NULL REFERENCES jobs (number) ON DELETE CASCADE,
    stage TEXT NOT NULL,
    step BIGINT NOT NULL,
    train DOUBLE PRECISION,
    validation DOUBLE PRECISION,
    PRIMARY KEY (job, stage, step)
);

-- A deleted version keeps its row, so that its number is never given again.
CREATE TABLE model_versions (
    model TEXT NOT NULL,
    version BIGINT NOT NULL,
    job BIGINT UNIQUE,
    published_s DOUBLE PRECISION,
    deleted_s DOUBLE PRECISION,
    PRIMARY KEY (model, version)
);

CREATE TABLE active_versions (
    model TEXT PRIMARY KEY,
    version BIGINT NOT NULL,
    since_s DOUBLE PRECISION NOT NULL
);

CREATE TABLE api_keys (
    id TEXT PRIMARY KEY,
    name TEXT NOT NULL,
    hash TEXT NOT NULL,
    created_s DOUBLE PRECISION NOT NULL,
    revoked_s DOUBLE PRECISION
);
