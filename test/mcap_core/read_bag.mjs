// Reads MCAP files by index and by stream; says on standard output what is in each, as a JSON line.
import { createHash } from 'node:crypto';
import { open, readFile } from 'node:fs/promises';
import { createRequire } from 'node:module';

const require = createRequire(import.meta.url);
const { McapIndexedReader, McapStreamReader } = require('@mcap/core');
const { decompress } = require('fzstd');

const decompressHandlers = { zstd: (bytes, size) => decompress(bytes, new Uint8Array(Number(size))) };

// Topic by topic: type, number of messages, a hash over log times and bytes, one over all the rest.
async function byIndex(path) {
  const file = await open(path);
  const readable = {
    size: async () => BigInt((await file.stat()).size),
    read: async (offset, length) => {
      const bytes = new Uint8Array(Number(length));
      await file.read(bytes, 0, Number(length), Number(offset));
      return bytes;
    },
  };
  const reader = await McapIndexedReader.Initialize({ readable, decompressHandlers });
  const topics = {};
  const head = Buffer.alloc(20);
  let ordered = true;
  let last = 0n;
  for await (const message of reader.readMessages({ validateCrcs: true })) {
    const channel = reader.channelsById.get(message.channelId);
    const type = reader.schemasById.get(channel.schemaId).name;
    const known = (topics[channel.topic] ??= { type, count: 0, bytes: createHash('sha256'), rest: createHash('sha256') });
    head.writeBigUInt64LE(message.logTime, 0);
    head.writeBigUInt64LE(message.publishTime, 8);
    head.writeUInt32LE(message.sequence, 16);
    known.bytes.update(head.subarray(0, 8)).update(message.data);
    known.rest.update(head.subarray(8));
    known.count += 1;
    ordered &&= message.logTime >= last;
    last = message.logTime;
  }
  for (const known of Object.values(topics)) {
    for (const name of ['bytes', 'rest']) known[name] = known[name].digest('hex');
  }
  await file.close();
  const { messageCount, chunkCount } = reader.statistics;
  return { topics, ordered, messageCount, chunkCount, indexes: reader.chunkIndexes.length };
}

async function byStream(path) {
  const stream = new McapStreamReader({ decompressHandlers, validateCrcs: true });
  stream.append(await readFile(path));
  let streamed = 0n;
  for (let record; (record = stream.nextRecord()); ) streamed += record.type === 'Message' ? 1n : 0n;
  return { streamed, done: stream.done() };
}

for (const path of process.argv.slice(2)) {
  let said;
  try {
    said = { ...(await byIndex(path)), ...(await byStream(path)) };
  } catch (error) {
    said = { error: String(error) };
  }
  process.stdout.write(JSON.stringify(said, (_, v) => (typeof v === 'bigint' ? Number(v) : v)) + '\n');
}
