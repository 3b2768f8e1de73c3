import './app.css';
import { mount } from 'svelte';
import App from './App.svelte';

const target = document.getElementById('app');
if (target === null) throw new Error('index.html has no element `app`');
// The newest thing that it asks of a browser: where that is missing, half a console would run. Then the page goes on saying so.
if ('any' in AbortSignal) {
  target.replaceChildren();
  mount(App, { target });
}
