-- Understood by SQLite and PostgreSQL alike.

-- How much work is saved, how much was saved when the current attempt started, and how many attempts in a row ended
-- abnormally without saving more.
ALTER TABLE jobs ADD COLUMN checkpoint BIGINT NOT NULL DEFAULT 0;
ALTER TABLE jobs ADD COLUMN claimed_checkpoint BIGINT NOT NULL DEFAULT 0;
ALTER TABLE jobs ADD COLUMN stalled_attempts BIGINT NOT NULL DEFAULT 0;

-- What evaluation jobs measured, of published and shipped versions. The hash says of which weights.
CREATE TABLE model_metrics (
    model TEXT NOT NULL,
    version BIGINT NOT NULL,
    weights_sha256 TEXT NOT NULL,
    metrics TEXT NOT NULL,
    measured_s DOUBLE PRECISION NOT NULL,
    PRIMARY KEY (model, version)
);
