// Reads an MCAP file by index and by stream; says on standard output what is in it, as JSON lines.
import { createHash } from 'node:crypto';
import { open, readFile } from 'node:fs/promises';
import { createRequire } from 'node:module';

const require = createRequire(import.meta.url);
const { McapIndexedReader, McapStreamReader } = require('@mcap/core');
const { decompress } = require('fzstd');

const decompressHandlers = { zstd: (bytes, size) => decompress(bytes, new Uint8Array(Number(size))) };
const say = (value) => process.stdout.write(JSON.stringify(value, (_, v) => (typeof v === 'bigint' ? String(v) : v)) + '\n');
const digest = (bytes) => createHash('sha256').update(bytes).digest('hex');

const path = process.argv[2];
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
for await (const message of reader.readMessages({ validateCrcs: true })) {
  const channel = reader.channelsById.get(message.channelId);
  const schema = reader.schemasById.get(channel.schemaId);
  say([channel.topic, schema.name, message.logTime, message.publishTime, message.sequence, digest(message.data)]);
}
const { messageCount, chunkCount } = reader.statistics;
await file.close();

const stream = new McapStreamReader({ decompressHandlers, validateCrcs: true });
stream.append(await readFile(path));
let streamed = 0n;
for (let record; (record = stream.nextRecord()); ) {
  streamed += record.type === 'Message' ? 1n : 0n;
}
say({ messageCount, chunkCount, indexes: reader.chunkIndexes.length, streamed, done: stream.done() });
