// Short tones for rewards and for the end of an episode.

let context = null;

/** Must be called from a click: browsers play no sound before one. */
export function enable() {
  context ??= new AudioContext();
  context.resume();
}

export function tone(frequency, seconds) {
  if (!context) return;
  const [source, volume] = [context.createOscillator(), context.createGain()];
  source.frequency.value = frequency;
  volume.gain.setValueAtTime(0.08, context.currentTime);
  volume.gain.exponentialRampToValueAtTime(0.001, context.currentTime + seconds);
  source.connect(volume).connect(context.destination);
  source.start();
  source.stop(context.currentTime + seconds);
}
