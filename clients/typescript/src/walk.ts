/** Steps the task `walk`: the robots stand for two seconds. Usage: npm run walk -- ws/127.0.0.1:10000 */

import { Environments } from "./client.js";

const envs = await Environments.open(process.argv[2] ?? "ws/127.0.0.1:10000", 4);
const observations = await envs.reset(1);
console.log(`${envs.count} environments, ${observations.length / envs.count} observations, ${envs.actionLength} actions`);
let total = 0;
let ended = 0;
const since = Date.now();
for (let index = 0; index < 100; index++) {
  const result = await envs.step(new Float32Array(envs.count * envs.actionLength));
  total += result.rewards.reduce((sum, reward) => sum + reward, 0);
  ended += result.terminated.filter(Boolean).length;
}
const rate = 100 / ((Date.now() - since) / 1000);
console.log(`mean reward ${(total / (100 * envs.count)).toFixed(4)}, ${ended} falls, ${rate.toFixed(0)} steps/s`);
await envs.close();
